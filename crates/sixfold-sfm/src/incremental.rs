//! A reconstruction that grows photograph by photograph (Schönberger and Frahm 2016, "Structure-from-Motion Revisited", section 4):
//! pose by PnP from the known points, triangulation of new points, bundle adjustment, removal of wrong observations.

use rayon::prelude::*;
use sixfold_geometry::{PnpOptions, Pose, Vec2, Vec3, pnp_ransac};

use crate::bundle::{Bundle, Seen, adjusted};
use crate::error::LeftOut;
use crate::lens::Lens;
use crate::options::SfmOptions;
use crate::tracks::Track;
use crate::triangulate::{triangulated, widest};

/// Maximum number of pairs of photographs from which a point is triangulated to reject wrong observations.
/// Chosen by hand; not swept.
const PAIRS: usize = 15;
/// Minimum fraction of the known points in a photograph that agree with its pose. Chosen by hand; not swept.
const AGREEING: f64 = 0.2;
/// The bundle is adjusted again when the number of photographs has grown by this factor. Chosen by hand; not swept.
const GROWTH: f64 = 1.15;
/// Factor on the threshold while a photograph's pose is searched. Chosen by hand; not swept.
const COARSE: f64 = 1.5;

/// Lens parameters that may change: with few photographs, and with many.
const FIRST: [usize; 2] = [0, 3];
const ALL: [usize; 5] = [0, 1, 2, 3, 4];
/// Minimum number of photographs to refine the lens at all, and in all parameters. Chosen by hand; not swept.
const ENOUGH: [usize; 2] = [4, 8];

/// The current state.
#[derive(Clone)]
pub(crate) struct Growing<'a> {
    pub pixels: &'a [Vec<Vec2>],
    pub tracks: &'a [Track],
    pub options: &'a SfmOptions,
    pub guess: Lens,
    pub lens: Lens,
    pub poses: Vec<Option<Pose>>,
    /// For each track, its point and which of its features agree with it.
    pub points: Vec<Option<(Vec3, Vec<bool>)>>,
    pub left_out: Vec<Option<LeftOut>>,
}

impl<'a> Growing<'a> {
    /// Starts with two photographs and the motion between them; `None` if they have too few points in common.
    pub fn started(
        pixels: &'a [Vec<Vec2>],
        tracks: &'a [Track],
        options: &'a SfmOptions,
        lens: &Lens,
        pair: (usize, usize),
        motion: &Pose,
    ) -> Option<Growing<'a>> {
        let mut poses = vec![None; pixels.len()];
        (poses[pair.0], poses[pair.1]) = (Some(Pose::identity()), Some(*motion));
        let points = vec![None; tracks.len()];
        let left_out = vec![None; pixels.len()];
        let mut state =
            Growing { pixels, tracks, options, guess: *lens, lens: *lens, poses, points, left_out };
        state.add_points();
        state.adjust(10);
        (state.points.iter().flatten().count() >= options.min_matches / 2).then_some(state)
    }

    pub fn registered(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// Number of observations that agree.
    pub fn agreeing(&self) -> usize {
        self.points.iter().flatten().map(|(_, used)| used.iter().filter(|u| **u).count()).sum()
    }

    /// Adds all photographs of `among` that can be registered; `go` is called after each and can stop it.
    pub fn grow(&mut self, among: &[usize], go: &dyn Fn(usize) -> bool) -> bool {
        let mut adjusted_at = self.registered();
        let mut failed: Vec<usize> = vec![];
        let mut again = true;
        loop {
            let known: Vec<(usize, usize)> = among
                .iter()
                .filter(|i| self.poses[**i].is_none() && !failed.contains(i))
                .map(|i| (self.known_in(*i).len(), *i))
                .collect();
            let next = known.iter().max_by_key(|(count, i)| (*count, std::cmp::Reverse(*i)));
            let Some((_, next)) = next.copied() else {
                // Retry those that failed, with everything added since.
                let progress = again && !failed.is_empty() && self.registered() > 2;
                if !progress {
                    break;
                }
                again = false;
                self.adjust(10);
                self.add_points();
                failed.clear();
                continue;
            };
            match self.register(next) {
                Ok(()) => {
                    self.left_out[next] = None;
                    self.add_points();
                    again = true;
                    let count = self.registered();
                    if count as f64 >= GROWTH * adjusted_at as f64 || count < 8 {
                        self.adjust(8);
                        adjusted_at = count;
                    }
                }
                Err(reason) => {
                    self.left_out[next] = Some(reason);
                    failed.push(next);
                }
            }
            if !go(self.registered()) {
                return false;
            }
        }
        true
    }

    /// Tracks with a known point in a photograph, and the photograph's feature.
    fn known_in(&self, photograph: usize) -> Vec<(usize, u32)> {
        let mut known = vec![];
        for (i, track) in self.tracks.iter().enumerate() {
            if self.points[i].is_some()
                && let Ok(at) = track.binary_search_by_key(&photograph, |t| t.0)
            {
                known.push((i, track[at].1));
            }
        }
        known
    }

    fn register(&mut self, photograph: usize) -> Result<(), LeftOut> {
        let known = self.known_in(photograph);
        let (minimum, of) = (self.options.min_matches / 2, known.len());
        let few = |found: usize| LeftOut::FewInliers { found, of };
        if of < minimum {
            return Err(few(of));
        }
        let points: Vec<Vec3> =
            known.iter().filter_map(|(i, _)| self.points[*i].as_ref().map(|p| p.0)).collect();
        let pixels: Vec<Vec2> = known.iter().map(|(_, f)| self.pixels[photograph][*f as usize]).collect();
        let options = PnpOptions {
            threshold_px: COARSE * self.options.threshold_px,
            max_iterations: 3000,
            seed: self.options.seed,
            ..PnpOptions::default()
        };
        let found = pnp_ransac(&points, &pixels, &self.lens.camera(), &options).map_err(|_| few(0))?;
        let enough = found.inlier_count >= minimum && found.inlier_count as f64 >= AGREEING * of as f64;
        if !enough {
            return Err(few(found.inlier_count));
        }
        self.poses[photograph] = Some(found.camera_from_object);
        Ok(())
    }

    /// Observations of a track in registered photographs: index in the track, pose, pixel.
    fn shown(&self, track: &Track) -> Vec<(usize, Pose, Vec2)> {
        let of = |(k, (photograph, feature)): (usize, &(usize, u32))| {
            Some((k, self.poses[*photograph]?, self.pixels[*photograph][*feature as usize]))
        };
        track.iter().enumerate().filter_map(of).collect()
    }

    /// Triangulates new points where possible, and adds the observations of all photographs that agree.
    pub fn add_points(&mut self) {
        let limit = self.options.threshold_px;
        let of = |i: usize| {
            let shown = self.shown(&self.tracks[i]);
            let agrees = |point: &Vec3, pose: &Pose, pixel: &Vec2| {
                self.lens.project(&pose.transform_point(point)).is_some_and(|p| (p - pixel).norm() < limit)
            };
            let point = match &self.points[i] {
                Some((point, _)) => *point,
                None => self.new_point(&shown, &agrees)?,
            };
            let mut used = vec![false; self.tracks[i].len()];
            let mut eyes = vec![];
            for (k, pose, pixel) in &shown {
                if agrees(&point, pose, pixel) {
                    used[*k] = true;
                    eyes.push(pose.inverse().translation());
                }
            }
            let enough = eyes.len() > 1 && widest(&point, &eyes) >= self.options.min_angle.to_radians();
            enough.then_some((point, used))
        };
        self.points = (0..self.tracks.len()).into_par_iter().map(of).collect();
    }

    fn new_point(
        &self,
        shown: &[(usize, Pose, Vec2)],
        agrees: &dyn Fn(&Vec3, &Pose, &Vec2) -> bool,
    ) -> Option<Vec3> {
        if shown.len() < 2 {
            return None;
        }
        let rays: Vec<(Pose, Vec2)> =
            shown.iter().filter_map(|(_, pose, pixel)| Some((*pose, self.lens.ray(pixel)?))).collect();
        if rays.len() != shown.len() {
            return None;
        }
        let pairs: Vec<(usize, usize)> =
            (0..rays.len()).flat_map(|a| (a + 1..rays.len()).map(move |b| (a, b))).collect();
        let every = pairs.len().div_ceil(PAIRS);
        let agreeing = |point: &Vec3| -> Vec<usize> {
            (0..shown.len()).filter(|k| agrees(point, &shown[*k].1, &shown[*k].2)).collect()
        };
        let mut best: Vec<usize> = vec![];
        for (a, b) in pairs.into_iter().step_by(every.max(1)) {
            let Some(point) = triangulated(&[rays[a], rays[b]]) else { continue };
            let eyes = [a, b].map(|k: usize| rays[k].0.inverse().translation());
            if widest(&point, &eyes) < self.options.min_angle.to_radians() {
                continue;
            }
            let found = agreeing(&point);
            if found.len() > best.len() {
                best = found;
            }
        }
        if best.len() < 2 {
            return None;
        }
        triangulated(&best.iter().map(|k| rays[*k]).collect::<Vec<_>>())
    }

    /// The lens parameters that may change now.
    fn free(&self) -> &'static [usize] {
        match self.registered() {
            _ if !self.options.refine_camera => &[],
            n if n >= ENOUGH[1] => &ALL,
            n if n >= ENOUGH[0] => &FIRST,
            _ => &[],
        }
    }

    /// Adjusts the bundle and removes observations that no longer agree.
    pub fn adjust(&mut self, iterations: usize) {
        let cameras: Vec<usize> = (0..self.poses.len()).filter(|i| self.poses[*i].is_some()).collect();
        let mut number = vec![usize::MAX; self.poses.len()];
        cameras.iter().enumerate().for_each(|(k, i)| number[*i] = k);
        let (mut of, mut points, mut seen) = (vec![], vec![], vec![]);
        for (i, track) in self.tracks.iter().enumerate() {
            let Some((point, used)) = &self.points[i] else { continue };
            let shown = track.iter().zip(used).filter(|(_, used)| **used);
            let shown = shown.map(|((photograph, feature), _)| Seen {
                camera: number[*photograph],
                pixel: self.pixels[*photograph][*feature as usize],
            });
            of.push(i);
            points.push(*point);
            seen.push(shown.collect());
        }
        let poses = cameras.iter().filter_map(|i| self.poses[*i]).collect();
        let start = Bundle { lens: self.lens, poses, points };
        let found = adjusted(start, &seen, &self.guess, self.free(), iterations);
        self.lens = found.lens;
        cameras.iter().zip(&found.poses).for_each(|(i, pose)| self.poses[*i] = Some(*pose));
        for (i, point) in of.iter().zip(&found.points) {
            if let Some((old, _)) = &mut self.points[*i] {
                *old = *point;
            }
        }
        self.add_points();
    }
}
