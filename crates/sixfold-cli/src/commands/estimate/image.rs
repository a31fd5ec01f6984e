//! `sixfold estimate` on one image.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, anyhow, bail};
use sixfold_align::PreparedDepth;
use sixfold_estimator::{Need, Object, PoseEstimator, Query};
use sixfold_geometry::{Camera, DepthImage, RgbImage, undistort_depth, undistort_rgb};
use sixfold_io::{CameraFile, read_depth, read_rgb, write_mask};
use sixfold_mttm::mask::to_image;
use sixfold_runner::{FoundObject, ImageReport, ImageRun, pose_table};
use sixfold_shell::Outcome;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::output::{report, write_atomically};
use sixfold_shell::overlay::{self, Drawn};
use sixfold_shell::progress::{Progress, check_interrupt};

use super::arguments::{CommonArguments, EstimateArguments};
use super::region::{self, Where};

/// One image, without lens distortion.
struct Input {
    /// The camera with its distortion.
    lens: Camera,
    camera: Camera,
    depth: Option<DepthImage>,
    rgb: Option<RgbImage>,
}

impl Input {
    /// Reads the files that the arguments name, and says what is missing.
    fn read(a: &CommonArguments, estimator: &dyn PoseEstimator) -> Result<Input> {
        let (needs, method) = (estimator.needs(), estimator.name());
        if needs.depth == Need::Required && a.depth.is_none() {
            // A method on colour needs depth for that alone.
            let with = if needs.rgb == Need::Required { " with --icp" } else { "" };
            bail!(
                "--method {method}{with} works on depth: give --depth FILE (with --camera and --object) or --dataset DIR"
            );
        }
        if needs.rgb == Need::Required && a.rgb.is_none() {
            bail!(
                "--method {method} needs a colour image: give --rgb FILE (with --camera and --box) or --dataset DIR"
            );
        }
        if needs.depth == Need::Unused && a.depth.is_some() {
            eprintln!("note: --depth is not used without --icp");
        }
        let camera_path = a.camera.as_deref().ok_or_else(|| anyhow!("--camera FILE is missing"))?;
        let file = CameraFile::read(camera_path)?;
        let raw_depth = match &a.depth {
            Some(path) if needs.depth != Need::Unused => {
                Some((path, read_depth(path, depth_scale(a, &file, camera_path)? / 1000.0)?))
            }
            _ => None,
        };
        let raw_rgb =
            a.rgb.as_ref().map(|path| Ok::<_, anyhow::Error>((path, read_rgb(path)?))).transpose()?;
        // The image that the method works on says which size the camera is for.
        let size = match (&raw_rgb, &raw_depth) {
            (Some((_, rgb)), _) if needs.rgb == Need::Required => rgb.size(),
            (_, Some((_, depth))) => depth.size(),
            (Some((_, rgb)), None) => rgb.size(),
            (None, None) => bail!("give --depth FILE or --rgb FILE"),
        };
        let lens = file.for_image(size.0, size.1, camera_path)?;
        let undo = |(path, raw): (&PathBuf, DepthImage)| {
            undistort_depth(&raw, &lens).with_context(|| path.display().to_string())
        };
        let depth = raw_depth.map(undo).transpose()?;
        let undo = |(path, raw): (&PathBuf, RgbImage)| {
            undistort_rgb(&raw, &lens).with_context(|| path.display().to_string())
        };
        let rgb = raw_rgb.map(undo).transpose()?;
        Ok(Input { lens, camera: lens.without_distortion(), depth, rgb })
    }

    /// The image as the method wants it.
    fn prepared(
        &self,
        a: &CommonArguments,
        estimator: &dyn PoseEstimator,
    ) -> Result<Option<Arc<PreparedDepth>>> {
        let Some(depth) = &self.depth else { return Ok(None) };
        let named = || a.depth.as_ref().map_or_else(String::new, |p| p.display().to_string());
        let prepared =
            PreparedDepth::new(depth, &self.camera, &estimator.depth_options()).with_context(named)?;
        Ok(Some(prepared))
    }
}

pub(super) fn run(a: &EstimateArguments) -> Result<Outcome> {
    let common = &a.common;
    let estimator = a.method.build(a.of_method(), common)?;
    let estimator = estimator.as_ref();
    let needs = estimator.needs();
    if common.objects.is_empty() && needs.object == Need::Required {
        bail!("--object NAME_OR_MESH is missing: what is to be found?");
    }
    if common.objects.len() > 1 && needs.region == Need::Required {
        bail!(
            "--object: found {} of them; --method {} takes one object and its --box at a time",
            common.objects.len(),
            estimator.name()
        );
    }
    let input = Input::read(common, estimator)?;
    // Before the poses take their time: what stands in the folder may be the input itself.
    let mut folder = common.out.as_deref().map(OutputFolder::take).transpose()?;
    folder.as_mut().map(|f| f.files(&["poses.json", "overlay.png"])).transpose()?;
    let depth = input.prepared(common, estimator)?;
    if let Some(depth) = &depth {
        warn_about(depth, estimator);
    }
    let place = region::find(common, &input.lens, input.rgb.as_ref())?;
    let region = match &place {
        Where::Anywhere if needs.region == Need::Required => bail!(
            "--method {} needs to know where the object is: give --detector FILE.safetensors, --box X,Y,W,H or --mask FILE",
            estimator.name()
        ),
        Where::In(region) => Some(region),
        Where::Anywhere | Where::Nowhere => None,
    };
    let query = Query {
        rgb: input.rgb.as_ref(),
        depth: depth.as_ref(),
        region,
        max_instances: common.instances.get(),
        // A person who asks about one image wants no guesses.
        min_confidence: common.min_score.unwrap_or(estimator.min_confidence().image),
        diagnostics: common.out.is_some(),
        ..Query::new(&input.camera)
    };
    let image = ImageRun { estimator, query };
    let found = search(common, &image, matches!(place, Where::Nowhere))?;
    let whole = image.report(&found);
    finish(common, folder.as_mut(), &input, &found, whole)
}

/// Searches every object.
fn search(a: &CommonArguments, image: &ImageRun<'_>, nowhere: bool) -> Result<Vec<FoundObject>> {
    let (store, cache) = (a.store.store(), a.cache.cache());
    let mut progress = Progress::new("objects", a.objects.len().max(1));
    let mut found = vec![];
    let names: Vec<Option<&String>> =
        if a.objects.is_empty() { vec![None] } else { a.objects.iter().map(Some).collect() };
    for name in names {
        check_interrupt("nothing was written")?;
        let object = match name {
            None => Object::of_model(a.object_id),
            Some(name) => {
                let (object, note) = store.find(name, a.unit, &cache)?;
                if let Some(note) = note {
                    eprintln!("note: {note}");
                }
                Object { id: a.object_id, ..object }
            }
        };
        // Of a mesh file the messages name the file.
        let named = || name.filter(|n| Path::new(n).is_file()).cloned().unwrap_or_default();
        let one = if nowhere {
            let object = image.estimator.prepare(&object).with_context(named)?;
            FoundObject { object, estimates: vec![], seconds: 0.0 }
        } else {
            image.find(&object).with_context(named)?
        };
        let notes = one.object.notes().iter().chain(one.estimates.iter().flat_map(|e| &e.notes));
        notes.for_each(|note| eprintln!("note: {note}"));
        progress.step(one.object.name().to_owned());
        found.push(one);
    }
    progress.finish();
    Ok(found)
}

/// Writes the poses, then the images, and prints the poses.
fn finish(
    a: &CommonArguments,
    folder: Option<&mut OutputFolder>,
    input: &Input,
    found: &[FoundObject],
    mut whole: ImageReport,
) -> Result<Outcome> {
    let mut images = vec![];
    if let Some(folder) = &a.out {
        let path = folder.join("overlay.png");
        images.push((path.clone(), overlaid(input, found)));
        whole.overlay = Some(path);
        for diagnostic in found.iter().flat_map(|f| &f.estimates).flat_map(|e| &e.diagnostics) {
            let path = folder.join(format!("{}.png", diagnostic.name));
            images.push((path.clone(), diagnostic.image.clone()));
            whole.diagnostics.insert(diagnostic.name.to_owned(), path);
        }
        write_atomically(&folder.join("poses.json"), serde_json::to_string_pretty(&whole)?.as_bytes())?;
    }
    let names: Vec<&str> = images.iter().filter_map(|(p, _)| p.file_name()?.to_str()).collect();
    report(&a.json, &whole, || {
        print!("{}", pose_table(&whole));
        if let Some(folder) = &a.out {
            println!("poses.json, {} are in {}", names.join(", "), folder.display());
        }
    })?;
    // Results first: an image that cannot be written costs none of them.
    if let Some(folder) = folder {
        for (name, image) in names.iter().zip(images.iter().map(|(_, image)| image)) {
            folder.write_rgb(name, image)?;
        }
        write_masks(folder, input, found)?;
    }
    Ok(if whole.poses.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

/// The masks of all poses that have one.
fn write_masks(folder: &mut OutputFolder, input: &Input, found: &[FoundObject]) -> Result<()> {
    for (i, f) in found.iter().enumerate() {
        for (k, estimate) in f.estimates.iter().enumerate() {
            if let Some(mask) = &estimate.mask {
                let name = format!("masks/{}-{}-{}.png", i + 1, file_name(f.object.name()), k + 1);
                write_mask(&folder.file(&name)?, &to_image(mask, input.camera.width, input.camera.height))?;
            }
        }
    }
    Ok(())
}

/// The poses over the image; where an object has no mesh, its mask.
fn overlaid(input: &Input, found: &[FoundObject]) -> RgbImage {
    let mut background = match (&input.rgb, &input.depth) {
        (Some(rgb), _) => rgb.clone(),
        (None, Some(depth)) => overlay::depth_picture(depth),
        (None, None) => RgbImage::filled(input.camera.width, input.camera.height, [0; 3]),
    };
    let mut drawn = vec![];
    for (i, f) in found.iter().enumerate() {
        for estimate in &f.estimates {
            match (f.object.mesh(), &estimate.mask) {
                (Some(mesh), _) => drawn.push(Drawn {
                    mesh,
                    camera_from_object: estimate.camera_from_object,
                    color: overlay::color(i),
                }),
                (None, Some(mask)) => overlay::tint(&mut background, mask, overlay::color(i)),
                (None, None) => {}
            }
        }
    }
    overlay::draw(&background, &input.camera, &drawn)
}

fn file_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() || c == '-' || c == '_' { c } else { '_' }).collect()
}

/// Millimetres per unit of the depth image.
fn depth_scale(a: &CommonArguments, file: &CameraFile, camera_path: &Path) -> Result<f64> {
    let scale = a.depth_scale.or(file.depth_scale).ok_or_else(|| {
        anyhow!(
            "{}: field depth_scale is missing: give it there or as --depth-scale (millimetres per unit of the depth image: 1 for most cameras)",
            camera_path.display()
        )
    })?;
    if !(scale > 0.0 && scale.is_finite()) {
        bail!("--depth-scale: found {scale}, expected above 0");
    }
    Ok(scale)
}

/// Says what makes a search of a depth image hopeless or slow.
fn warn_about(depth: &PreparedDepth, estimator: &dyn PoseEstimator) {
    let pixels = depth.depth().as_slice();
    let measured = pixels.iter().filter(|&&z| z > 0.0).count();
    if 10 * measured < pixels.len() {
        let percent = (100.0 * measured as f64 / pixels.len() as f64).round();
        eprintln!("note: only {percent} % of the depth image is measured");
    }
    if estimator.depth_options().remove_plane && depth.plane().is_none() {
        eprintln!("note: no table plane was found; all of the image is searched");
    }
}
