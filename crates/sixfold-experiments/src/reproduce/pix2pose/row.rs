//! One row of the table: a variant of using the model, its scores and its times.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, anyhow};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sixfold_bop::{Estimate, EvalOptions, Target, evaluate, write_results};
use sixfold_geometry::{Image, Rect, RgbImage};
use sixfold_pix2pose::aligned::AlignOptions;
use sixfold_pix2pose::estimate::Pix2PoseOptions;

use super::model::Pix2Pose;
use super::{Bench, Regions};
use sixfold_shell::progress::{Progress, check_interrupt};

/// A variant of using the model.
pub(super) struct Setting {
    /// Name of its files.
    pub key: String,
    /// Its title in the table.
    pub title: String,
    pub options: Pix2PoseOptions,
    /// Whether the outline is aligned as the last step.
    pub refine: bool,
    /// With refinement: the number of passes.
    pub passes: usize,
    /// With refinement: whether the model's known systematic error is corrected.
    pub correct: bool,
    /// With refinement: whether the refiner refines the aligned pose.
    pub refiner: bool,
    /// With refinement: whether borders are attracted to edges of the image.
    pub edges: bool,
    /// Ground-truth boxes are moved and scaled by up to this fraction of their size.
    pub noise: Option<f64>,
    /// Half of every box, at one of its sides, is made black, as in the dissertation's figure 3.12.
    pub half_black: bool,
    /// Index of the file of detections whose boxes replace the ground truth's.
    pub detections: Option<usize>,
}

/// A row as it is stored.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Row {
    pub key: String,
    pub title: String,
    pub boxes: String,
    pub scores: Scores,
    /// For detections: the quality of their boxes.
    #[serde(default)]
    pub detection: Option<RightBoxes>,
    /// Number of boxes that were searched.
    pub regions: usize,
    /// Number of poses found in them.
    pub found: usize,
    /// Per box: crops, both stages, PnP and, if used, refinement.
    pub milliseconds: Option<Times>,
}

/// Quality of detections, as in table 3.9 of the dissertation.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct RightBoxes {
    /// Fraction of the targets whose best box has an intersection over union above one half with the visible
    /// ground truth's box.
    pub fraction: f64,
    /// ADD(-S) below a tenth of the diameter over these targets alone.
    pub add_s: Option<f64>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Scores {
    pub targets: usize,
    pub ar_mssd: Option<f64>,
    pub ar_mspd: Option<f64>,
    /// ADD(-S) below a tenth of the diameter, over all targets.
    pub add_s: Option<f64>,
    /// The mean of the objects' recalls.
    pub add_s_mean_of_objects: Option<f64>,
    pub objects: BTreeMap<u32, ObjectScore>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct ObjectScore {
    pub targets: usize,
    pub ar_mssd: Option<f64>,
    pub ar_mspd: Option<f64>,
    pub add_s: Option<f64>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct Times {
    pub mean: f64,
    pub median: f64,
    pub slowest: f64,
    /// Threads that were used.
    pub threads: usize,
}

impl Setting {
    /// Both passes and PnP with the default options.
    pub fn plain(key: &str, title: &str) -> Setting {
        Setting {
            key: key.to_string(),
            title: title.to_string(),
            options: Pix2PoseOptions::default(),
            refine: false,
            passes: AlignOptions::default().passes,
            correct: true,
            refiner: true,
            edges: true,
            noise: None,
            half_black: false,
            detections: None,
        }
    }

    /// The model with the options of this variant.
    pub fn of(&self, pix2pose: &Pix2Pose, seed: u64) -> Pix2Pose {
        let mut options = AlignOptions {
            estimate: Pix2PoseOptions { seed, ..self.options.clone() },
            passes: self.passes,
            correct: self.correct,
            ..AlignOptions::default()
        };
        if !self.refiner {
            options.refiner_weight = 0.0;
        }
        if !self.edges {
            options.refine.edges = 0.0;
        }
        pix2pose.varied(options, self.refine)
    }

    /// The source of the boxes, in words.
    fn name_of_boxes(&self, detections: Option<&str>) -> String {
        match (detections, self.noise) {
            (Some(name), _) => name.to_owned(),
            (None, None) => "ground truth".to_string(),
            (None, Some(fraction)) => format!("ground truth, noise {:.0} %", 100.0 * fraction),
        }
    }
}

impl Bench {
    /// Estimates all targets with one variant, stores the poses and scores them.
    pub(super) fn measure(&self, pix2pose: &Pix2Pose, setting: &Setting, folder: &Path) -> Result<Row> {
        let detections = setting.detections.and_then(|number| self.detections.get(number));
        let boxes = detections.map_or(&self.truth, |d| &d.regions);
        let mut images: BTreeMap<(u32, u32), Vec<&Target>> = BTreeMap::new();
        for t in &self.targets {
            images.entry((t.scene_id, t.im_id)).or_default().push(t);
        }
        let (mut estimates, mut times, mut regions) = (vec![], vec![], 0);
        let mut scenes = BTreeMap::new();
        let mut progress = Progress::new("images", images.len());
        for ((scene_id, im_id), targets) in &images {
            check_interrupt("the finished rows are kept; run the same command again to continue")?;
            if let std::collections::btree_map::Entry::Vacant(place) = scenes.entry(*scene_id) {
                place.insert(self.dataset.scene(*scene_id)?);
            }
            let Some(scene) = scenes.get(scene_id) else { continue };
            let camera = scene.camera(*im_id)?;
            let image = scene.rgb(*im_id)?.ok_or_else(|| {
                anyhow!("image {scene_id}/{im_id} has no colour image, which Pix2Pose needs")
            })?;
            let begin = (estimates.len(), Instant::now());
            for o in targets.iter().filter_map(|t| t.object) {
                let none = vec![];
                let mine = boxes.get(&(*scene_id, *im_id, o.obj_id)).unwrap_or(&none);
                for (number, (region, score)) in mine.iter().enumerate() {
                    let region = match setting.noise {
                        Some(fraction) => moved(
                            region,
                            fraction,
                            [self.seed, (*scene_id).into(), (*im_id).into(), o.obj_id.into(), number as u64],
                        ),
                        None => *region,
                    };
                    let covered = setting.half_black.then(|| {
                        let side = self.seed + u64::from(*im_id) + u64::from(o.obj_id);
                        half_black(&image, &region, side % 4)
                    });
                    let image = covered.as_ref().unwrap_or(&image);
                    regions += 1;
                    let start = Instant::now();
                    let Some(mesh) = self.meshes.get(&o.obj_id) else { continue };
                    let posed = pix2pose.estimate(image, &camera, o.obj_id, &region, mesh);
                    times.push(start.elapsed().as_secs_f64());
                    match posed {
                        Ok(Some(p)) => estimates.push(Estimate::new(
                            *scene_id,
                            *im_id,
                            o.obj_id,
                            p.score * score,
                            p.camera_from_object,
                        )),
                        Ok(None) => {}
                        Err(error) => {
                            eprintln!(
                                "note: image {scene_id}/{im_id}, object {}: {}",
                                o.obj_id,
                                sixfold_shell::describe(&error)
                            );
                        }
                    }
                }
            }
            let seconds = begin.1.elapsed().as_secs_f64();
            for estimate in &mut estimates[begin.0..] {
                estimate.time = Some(seconds);
            }
            progress.step(format!("{scene_id}/{im_id}"));
        }
        progress.finish();
        let csv = folder.join("rows").join(format!("{}.csv", setting.key));
        std::fs::create_dir_all(folder.join("rows")).with_context(|| folder.display().to_string())?;
        write_results(&csv, &estimates)?;
        let name = setting.name_of_boxes(detections.map(|d| d.name.as_str()));
        let mut row = self.scored(&setting.key, &setting.title, &name, &estimates, times, regions)?;
        row.detection = detections.map(|d| self.right_boxes(&d.regions, &estimates)).transpose()?;
        Ok(row)
    }

    /// The fraction of detected targets, and the recall of poses on these targets.
    fn right_boxes(&self, detected: &Regions, estimates: &[Estimate]) -> Result<RightBoxes> {
        let overlaps = |t: &&Target| {
            let Some(key) = t.object.map(|o| (t.scene_id, t.im_id, o.obj_id)) else { return false };
            let best = detected.get(&key).and_then(|boxes| boxes.first());
            let truth = self.truth.get(&key).map_or(&[][..], Vec::as_slice);
            best.is_some_and(|(found, _)| truth.iter().any(|(b, _)| overlap(found, b) > RIGHT_BOX))
        };
        let right: Vec<Target> = self.targets.iter().filter(overlaps).copied().collect();
        let fraction = right.len() as f64 / self.targets.len().max(1) as f64;
        let options = EvalOptions { compute_vsd: false, ..EvalOptions::default() };
        let e = evaluate(&self.dataset, estimates, &right, &options, &())?;
        Ok(RightBoxes { fraction, add_s: e.add_s_recall.get("mean").copied().flatten() })
    }

    /// A row of estimates.
    pub(super) fn scored(
        &self,
        key: &str,
        title: &str,
        boxes: &str,
        estimates: &[Estimate],
        mut seconds: Vec<f64>,
        regions: usize,
    ) -> Result<Row> {
        let options = EvalOptions { compute_vsd: false, ..EvalOptions::default() };
        let e = evaluate(&self.dataset, estimates, &self.targets, &options, &())?;
        let objects: BTreeMap<u32, ObjectScore> = e
            .objects
            .iter()
            .filter_map(|(id, o)| {
                let (targets, add_s) = (o.targets, o.add_s_recall);
                Some((
                    id.parse().ok()?,
                    ObjectScore { targets, ar_mssd: o.ar_mssd, ar_mspd: o.ar_mspd, add_s },
                ))
            })
            .filter(|(_, o): &(u32, ObjectScore)| o.targets > 0)
            .collect();
        let each: Vec<f64> = objects.values().filter_map(|o| o.add_s).collect();
        seconds.sort_by(f64::total_cmp);
        let milliseconds = (!seconds.is_empty()).then(|| Times {
            mean: 1000.0 * seconds.iter().sum::<f64>() / seconds.len() as f64,
            median: 1000.0 * seconds[seconds.len() / 2],
            slowest: 1000.0 * seconds[seconds.len() - 1],
            threads: rayon::current_num_threads(),
        });
        Ok(Row {
            key: key.to_string(),
            title: title.to_string(),
            boxes: boxes.to_string(),
            scores: Scores {
                targets: e.targets,
                ar_mssd: e.ar_mssd,
                ar_mspd: e.ar_mspd,
                add_s: e.add_s_recall.get("mean").copied().flatten(),
                add_s_mean_of_objects: (!each.is_empty())
                    .then(|| each.iter().sum::<f64>() / each.len() as f64),
                objects,
            },
            detection: None,
            regions,
            found: e.estimates.saturating_sub(e.estimates_left_out),
            milliseconds,
        })
    }
}

/// Boxes with a larger overlap are right.
const RIGHT_BOX: f64 = 0.5;

/// Intersection over union.
fn overlap(a: &Rect, b: &Rect) -> f64 {
    let common = a.intersect(b).map_or(0.0, |r| r.width * r.height);
    common / (a.width * a.height + b.width * b.height - common)
}

/// The image with the left, right, upper or lower half of a box black.
fn half_black(image: &RgbImage, region: &Rect, side: u64) -> RgbImage {
    let (centre_x, centre_y) = (region.x + 0.5 * region.width, region.y + 0.5 * region.height);
    Image::from_fn(image.width(), image.height(), |x, y| {
        let (u, v) = (x as f64, y as f64);
        let inside =
            u >= region.x && v >= region.y && u < region.x + region.width && v < region.y + region.height;
        let half = match side {
            0 => u < centre_x,
            1 => u >= centre_x,
            2 => v < centre_y,
            _ => v >= centre_y,
        };
        if inside && half { [0; 3] } else { image[(x, y)] }
    })
}

/// The box with centre and sides changed by up to `fraction` of its sides; the same box and seed
/// give the same result.
fn moved(region: &Rect, fraction: f64, seed: [u64; 5]) -> Rect {
    let number = seed.iter().fold(0u64, |sum, v| sum.wrapping_mul(1_000_003).wrapping_add(*v));
    let mut random = ChaCha8Rng::seed_from_u64(number);
    let mut next = || random.random_range(-fraction..=fraction);
    let (dx, dy, dw, dh) = (next(), next(), next(), next());
    let (width, height) = (region.width * (1.0 + dw), region.height * (1.0 + dh));
    Rect {
        x: region.x + dx * region.width + 0.5 * (region.width - width),
        y: region.y + dy * region.height + 0.5 * (region.height - height),
        width,
        height,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlap_is_intersection_over_union() {
        let of = |x: f64, width: f64| Rect { x, y: 0.0, width, height: 10.0 };
        assert_eq!(overlap(&of(0.0, 10.0), &of(0.0, 10.0)), 1.0);
        assert!((overlap(&of(0.0, 10.0), &of(5.0, 10.0)) - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!(overlap(&of(0.0, 10.0), &of(20.0, 10.0)), 0.0);
    }

    #[test]
    fn half_of_a_box_is_painted_black() {
        let image = RgbImage::from_fn(20, 20, |_, _| [200; 3]);
        let region = Rect { x: 4.0, y: 6.0, width: 8.0, height: 10.0 };
        let halves = [(4..8, 6..16), (8..12, 6..16), (4..12, 6..11), (4..12, 11..16)];
        for (side, (columns, rows)) in halves.into_iter().enumerate() {
            let covered = half_black(&image, &region, side as u64);
            for y in 0..20 {
                for x in 0..20 {
                    let black = columns.contains(&x) && rows.contains(&y);
                    assert_eq!(covered[(x, y)] == [0; 3], black, "{side} {x} {y}");
                }
            }
        }
    }

    #[test]
    fn noise_is_bounded_repeatable_and_different_for_every_box() {
        let region = Rect { x: 100.0, y: 50.0, width: 40.0, height: 20.0 };
        let centre = |r: &Rect| (r.x + 0.5 * r.width, r.y + 0.5 * r.height);
        let mut seen = vec![];
        for image in 0..200 {
            let m = moved(&region, 0.2, [0, 2, image, 5, 0]);
            assert_eq!(m, moved(&region, 0.2, [0, 2, image, 5, 0]));
            let (dx, dy) = (centre(&m).0 - 120.0, centre(&m).1 - 60.0);
            assert!(dx.abs() <= 8.0 + 1e-9 && dy.abs() <= 4.0 + 1e-9, "{m:?}");
            assert!((m.width - 40.0).abs() <= 8.0 + 1e-9 && (m.height - 20.0).abs() <= 4.0 + 1e-9, "{m:?}");
            assert!(!seen.contains(&m));
            seen.push(m);
        }
        let furthest = seen.iter().map(|m| (centre(m).0 - 120.0).abs()).fold(0.0, f64::max);
        assert!(furthest > 6.0, "{furthest}");
        assert_eq!(moved(&region, 0.0, [0; 5]), region);
    }
}
