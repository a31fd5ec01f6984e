//! Templates of a dataset's objects from its own depth images, as the dissertation's real templates (section 5.3.4).

use std::collections::BTreeSet;
use std::collections::btree_map::{BTreeMap, Entry};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use clap::Args;
use sixfold_bop::{BopDataset, MaskKind, Models, Scene, VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_geometry::{Camera, DepthImage, Mask, Pose, Rect, undistort_depth};
use sixfold_mesh::Mesh;
use sixfold_mttm::{DepthView, ObjectTemplates, TemplateOptions};

use crate::datasets;
use crate::progress::{Progress, check_interrupt};

/// Least visible fraction of an object for a template: the text has "without heavy occlusion". Chosen by hand; not swept.
const MIN_VISIBLE: f64 = 0.8;
/// Most images of an object, evenly spaced (dissertation, section 5.3.4: approximately 1,000).
const MAX_IMAGES: usize = 1000;

/// Templates of `sixfold estimate --method mttm --dataset` from depth images.
#[derive(Debug, Args)]
pub struct ImageTemplateArguments {
    /// Take templates from the depth images of this split of the dataset, with their annotated poses, instead of rendering them:
    /// of objects at least 80 % visible, at most 1000 images of each
    #[arg(long, value_name = "SPLIT", requires = "dataset", conflicts_with = "templates")]
    pub template_images: Option<String>,
    /// Take templates only from these of its images: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE", requires = "template_images")]
    pub template_frames: Option<PathBuf>,
}

impl ImageTemplateArguments {
    /// The templates of each object of the dataset in `root`, whose split `searched` is searched for the objects `ids` (all if
    /// empty); none without the option.
    ///
    /// # Errors
    /// When a file is missing or broken, when no image shows one of the objects well enough, and when the images are those that
    /// are searched.
    pub fn templates(
        &self,
        root: Option<&Path>,
        searched: &str,
        models: Option<&str>,
        ids: &[u32],
    ) -> Result<Arc<BTreeMap<u32, ObjectTemplates>>> {
        let (Some(split), Some(root)) = (&self.template_images, root) else { return Ok(Arc::default()) };
        if split == searched && self.template_frames.is_none() {
            bail!(
                "--template-images {split}: these images are searched themselves; choose others with --template-frames FILE"
            );
        }
        let dataset = datasets::open(root, split, models)?;
        Ok(Arc::new(of_images(&dataset, self.template_frames.as_deref(), ids)?))
    }
}

/// Templates from the images of a dataset's split, or only from its frames in the file `frames`: of the objects `ids`, or of all
/// objects there if `ids` is empty. Masks are those of the dataset (`mask_visib`), or rendered from the annotations and compared
/// with the depth image.
fn of_images(
    dataset: &BopDataset,
    frames: Option<&Path>,
    ids: &[u32],
) -> Result<BTreeMap<u32, ObjectTemplates>> {
    let images = dataset.images(frames).context("--template-frames")?;
    let mut scenes = BTreeMap::new();
    for scene_id in images.iter().map(|i| i.0).collect::<BTreeSet<u32>>() {
        scenes.insert(scene_id, dataset.scene(scene_id)?);
    }
    let mut reader = Reader { dataset, scenes, meshes: BTreeMap::new(), depth: None };
    let places = reader.places(&images, ids)?;
    let mut views: BTreeMap<u32, Vec<View>> = places.keys().map(|id| (*id, vec![])).collect();
    // Image by image, so that each depth image is read once.
    let mut places: Vec<(Place, u32)> =
        places.into_iter().flat_map(|(id, places)| places.into_iter().map(move |p| (p, id))).collect();
    places.sort();
    let mut progress = Progress::new("views for templates", places.len());
    for (place, id) in places {
        check_interrupt("no pose was estimated yet")?;
        views.entry(id).or_default().extend(reader.view(place)?);
        progress.step(format!("image {}/{}, object {id}", place.scene_id, place.im_id));
    }
    let mut templates = BTreeMap::new();
    for (id, views) in views {
        if views.is_empty() {
            bail!(
                "--template-images: no depth image of {} shows object {id} at least {:.0} % visible; choose other images, or leave \
                 the object out (--ids)",
                dataset.split(),
                100.0 * MIN_VISIBLE
            );
        }
        let views: Vec<DepthView<'_>> = views.iter().map(View::depth_view).collect();
        let cut = ObjectTemplates::from_depth(&views, &TemplateOptions::default());
        templates.insert(id, cut.with_context(|| format!("--template-images: object {id}"))?);
    }
    progress.finish();
    Ok(templates)
}

/// An object in an image, cut out.
struct View {
    depth: DepthImage,
    camera: Camera,
    mask: Mask,
    pose: Pose,
}

impl View {
    fn depth_view(&self) -> DepthView<'_> {
        let View { depth, camera, mask, pose } = self;
        DepthView { depth, camera, mask, camera_from_object: Some(*pose) }
    }
}

/// An object in an image: the scene, the image, and the object's place in the image's ground truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    scene_id: u32,
    im_id: u32,
    index: usize,
}

struct Reader<'a> {
    dataset: &'a BopDataset,
    scenes: BTreeMap<u32, Scene>,
    /// Models that were needed for a mask.
    meshes: BTreeMap<u32, Mesh>,
    /// The last depth image, with the numbers of its scene and image.
    depth: Option<((u32, u32), DepthImage)>,
}

impl Reader<'_> {
    /// Where each object can be seen, without images in which it is known to be hidden.
    fn places(&self, images: &BTreeSet<(u32, u32)>, ids: &[u32]) -> Result<BTreeMap<u32, Vec<Place>>> {
        let mut places: BTreeMap<u32, Vec<Place>> = ids.iter().map(|id| (*id, vec![])).collect();
        for &(scene_id, im_id) in images {
            let image = self.scenes[&scene_id].image(im_id)?;
            for (index, (truth, visible)) in
                image.ground_truth.iter().zip(image.visible_fractions()).enumerate()
            {
                let wanted = ids.is_empty() || ids.contains(&truth.obj_id);
                if wanted && visible.is_none_or(|v| v >= MIN_VISIBLE) {
                    places.entry(truth.obj_id).or_default().push(Place { scene_id, im_id, index });
                }
            }
        }
        for of_object in places.values_mut() {
            *of_object = evenly(of_object, MAX_IMAGES);
        }
        Ok(places)
    }

    /// The view of an object; `None` if it is too much hidden, or too little of it has depth.
    fn view(&mut self, place: Place) -> Result<Option<View>> {
        let Place { scene_id, im_id, index } = place;
        let scene = &self.scenes[&scene_id];
        let image = scene.image(im_id)?;
        let camera = scene.camera(im_id)?;
        let read = || -> Result<DepthImage> {
            scene.depth(im_id)?.with_context(|| {
                format!(
                    "--template-images: image {scene_id}/{im_id} of {} has no depth image; simulate it with `sixfold simulate-depth`",
                    self.dataset.split()
                )
            })
        };
        let depth = match self.depth.take() {
            Some((of, depth)) if of == (scene_id, im_id) => depth,
            _ => read()?,
        };
        let depth = &self.depth.insert(((scene_id, im_id), depth)).1;
        let mask = match scene.mask(im_id, index, MaskKind::Visible)? {
            Some(mask) if image.visible_fractions()[index].is_some() => mask,
            _ => {
                let truth = &image.ground_truth[index];
                let mesh = match self.meshes.entry(truth.obj_id) {
                    Entry::Occupied(known) => known.into_mut(),
                    Entry::Vacant(place) => {
                        place.insert(self.dataset.model(truth.obj_id, Models::Rendering)?)
                    }
                };
                let placed = [(&*mesh, truth.camera_from_object)];
                let mut visible = ground_truth_visibility(&placed, &camera, Some(depth), VISIBILITY_DELTA);
                match visible.pop().filter(|v| v.info.visib_fract >= MIN_VISIBLE) {
                    Some(visible) => visible.mask_visible,
                    None => return Ok(None),
                }
            }
        };
        let depth = undistort_depth(depth, &camera)?;
        let camera = camera.without_distortion();
        // Only the part around the object is kept: a split may have thousands of images.
        let Some([left, top, width, height]) = mask.bounding_box() else { return Ok(None) };
        let part = Rect { x: left as f64, y: top as f64, width: width as f64, height: height as f64 };
        let cut = |x: usize, y: usize| (left + x, top + y);
        let view = View {
            depth: DepthImage::from_fn(width, height, |x, y| depth[cut(x, y)]),
            mask: Mask::from_fn(width, height, |x, y| mask[cut(x, y)]),
            camera: camera.crop(&part),
            pose: image.ground_truth[index].camera_from_object,
        };
        Ok(Some(view).filter(|v| v.depth_view().shows_enough()))
    }
}

/// At most `number` of `all`, evenly spaced.
fn evenly<T: Copy>(all: &[T], number: usize) -> Vec<T> {
    let kept = all.len().min(number);
    (0..kept).map(|k| all[k * all.len() / kept]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_many_images_some_are_taken_from_all_of_them() {
        assert_eq!(evenly(&[1, 2, 3], 5), [1, 2, 3]);
        assert_eq!(evenly(&[0, 1, 2, 3, 4, 5, 6], 3), [0, 2, 4]);
        assert!(evenly::<u8>(&[], 3).is_empty());
    }
}
