//! Times of a view and of a refinement.

use std::time::Instant;

use anyhow::Result;
use serde::{Deserialize, Serialize};
use sixfold_data::PosedImage;
use sixfold_nol::refine::{PoseRefinementOptions, refine_poses};

use super::material::{Material, Source};
use super::views::{Networks, ways};

/// Side of the views, pixels: the dissertation's.
const SIDE: usize = 256;
/// Views that are timed.
const VIEWS: usize = 5;

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Speed {
    /// The object: the one with the most sources.
    pub object: u32,
    pub sources: usize,
    pub threads: usize,
    /// Pixels along a side of the views and crops.
    pub side: usize,
    /// Seconds before the first view: crops, and the network's encoding of all sources.
    pub preparation: f64,
    pub views: Vec<ViewTime>,
    /// Seconds of the default refinement of these sources alone.
    pub refinement: f64,
}

/// Means over the views.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct ViewTime {
    /// The method of combining colours.
    pub method: String,
    pub seconds: f64,
    /// Photographs per view.
    pub sources: f64,
}

pub(super) fn measure(material: &Material, sources: &[Source], networks: &Networks) -> Result<Speed> {
    let count = |object: &u32| sources.iter().filter(|s| s.object == *object).count();
    // The first one of several with equal numbers.
    let most = material.meshes.keys().map(count).max().unwrap_or(0);
    let object = material.meshes.keys().copied().find(|o| count(o) == most).unwrap_or(0);
    let mesh = &material.meshes[&object];
    let photographs: Vec<PosedImage> =
        sources.iter().filter(|s| s.object == object).map(|s| s.photograph.clone()).collect();
    let start = Instant::now();
    refine_poses(&photographs, mesh, &PoseRefinementOptions::default(), &())?;
    let refinement = start.elapsed().as_secs_f64();
    let start = Instant::now();
    let ways = ways("", mesh, &photographs, &networks[..networks.len().min(1)], SIDE, false);
    let preparation = start.elapsed().as_secs_f64();
    let views = ways
        .iter()
        .map(|way| {
            let start = Instant::now();
            let targets = &way.maker.sources()[..way.maker.sources().len().min(VIEWS)];
            let behind: usize = targets
                .iter()
                .map(|t| way.maker.render(&t.camera, t.camera_from_object()).sources.len())
                .sum();
            let timed = targets.len().max(1) as f64;
            ViewTime {
                method: way.method.clone(),
                seconds: start.elapsed().as_secs_f64() / timed,
                sources: behind as f64 / timed,
            }
        })
        .collect();
    Ok(Speed {
        object,
        sources: photographs.len(),
        threads: rayon::current_num_threads(),
        side: SIDE,
        preparation,
        views,
        refinement,
    })
}
