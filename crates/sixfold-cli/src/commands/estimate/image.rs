//! `sixfold estimate` on one image.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, anyhow, bail};
use sixfold_align::PreparedDepth;
use sixfold_estimator::{Need, Object, PoseEstimator, Query};
use sixfold_geometry::{Camera, DepthImage, RgbImage, undistort_depth, undistort_rgb};
use sixfold_io::{CameraFile, read_depth, read_rgb};
use sixfold_runner::{FoundObject, ImageRun, depth_notes, without_overruled};
use sixfold_shell::Outcome;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::found::SearchedImage;
use sixfold_shell::progress::Progress;

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
    /// Reads the files that the arguments name; an error states what is missing.
    fn read(a: &CommonArguments, estimator: &dyn PoseEstimator) -> Result<Input> {
        let (needs, method) = (estimator.needs(), estimator.name());
        if needs.depth == Need::Required && a.depth.is_none() {
            // A colour method needs depth only for ICP.
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
        if a.depth.is_none() && a.rgb.is_none() {
            bail!(
                "--method {method} works on depth, colour or both: give --depth FILE, --rgb FILE (with --camera and --object) or --dataset DIR"
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
        // The image that the method uses determines the size for the camera.
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

    /// The image, prepared for the method.
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
    // Check the folder before the search, which takes time: it may contain the input itself.
    let mut folder = common.out.as_deref().map(OutputFolder::take).transpose()?;
    folder.as_mut().map(|f| f.files(&["poses.json", "overlay.png"])).transpose()?;
    let depth = input.prepared(common, estimator)?;
    if let Some(depth) = &depth {
        depth_notes(depth, estimator).iter().for_each(|note| eprintln!("note: {note}"));
    }
    let place = region::find(common, &input.lens, input.rgb.as_ref())?;
    let region = match &place {
        Where::Anywhere if needs.region == Need::Required => bail!(
            "--method {} needs a region that contains the object: give --detector FILE.safetensors, --box \
             X,Y,W,H or --mask FILE",
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
        // For one image, a person wants no guesses.
        min_confidence: common.min_score.unwrap_or(estimator.min_confidence().image),
        diagnostics: common.out.is_some(),
        ..Query::new(&input.camera)
    };
    let image = ImageRun { estimator, query };
    let mut found = search(common, &image, matches!(place, Where::Nowhere))?;
    let overruled = without_overruled(&mut found);
    if overruled > 0 {
        eprintln!("note: {overruled} poses are left out: most of their pixels belong to more confident ones");
    }
    let searched = SearchedImage {
        camera: &input.camera,
        rgb: input.rgb.as_ref(),
        depth: input.depth.as_ref(),
        found: &found,
    };
    searched.finish(folder, &common.json, image.report(&found))
}

/// Searches every object.
fn search(a: &CommonArguments, image: &ImageRun<'_>, nowhere: bool) -> Result<Vec<FoundObject>> {
    let (store, cache) = (a.store.store(), a.cache.cache());
    let mut progress = Progress::new("objects", a.objects.len().max(1));
    let mut found = vec![];
    let names: Vec<Option<&String>> =
        if a.objects.is_empty() { vec![None] } else { a.objects.iter().map(Some).collect() };
    for name in names {
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
        // For a mesh file, messages name the file.
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
