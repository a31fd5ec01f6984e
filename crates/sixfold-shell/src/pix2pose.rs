//! Pix2Pose as the commands use it: model, options, refinement and alignment with depth in one.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::path::Path;
use std::sync::{Arc, Mutex};

use anyhow::{Context, Result, anyhow, bail};
use sixfold_geometry::{Camera, Image, Mask, Pose, Rect, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_align::outline::outline_mesh;
use sixfold_pix2pose::aligned::{AlignOptions, estimate_aligned};
use sixfold_pix2pose::depth::{AlignedToDepth, DepthScene};
use sixfold_pix2pose::estimate::{EstimateOptions, Found, View, estimate};
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_pix2pose::object::ObjectEntry;

/// A model ready to be used.
#[derive(Clone)]
pub struct Pix2Pose {
    model: Pix2PoseModel,
    options: AlignOptions,
    /// Whether outlines are aligned; otherwise poses are those of PnP.
    aligns: bool,
    /// The objects' meshes as the alignment draws them, made when first needed.
    outlines: Arc<Mutex<BTreeMap<u32, Arc<Mesh>>>>,
}

/// A pose with its score and what it came from.
pub struct Pix2PosePose {
    /// The pose.
    pub camera_from_object: Pose,
    /// Higher is better.
    pub score: f64,
    /// Whether the outline was aligned with the image.
    pub refined: bool,
    /// What the network found.
    pub found: Found,
}

impl Pix2Pose {
    /// The model of a weight file as `sixfold estimate` sets it: its seed, at most so many looks at an object, and whether
    /// outlines are aligned.
    pub fn new(
        weights: Option<&Path>,
        seed: u64,
        looks: Option<NonZeroUsize>,
        aligns: bool,
    ) -> Result<Pix2Pose> {
        let weights = weights.ok_or_else(|| {
            anyhow!(
                "--method pix2pose needs --weights FILE.safetensors, which `sixfold train pix2pose` writes"
            )
        })?;
        let pix2pose = Pix2Pose::load(weights)?;
        let estimate = EstimateOptions { seed, ..EstimateOptions::default() };
        let options = AlignOptions { estimate, ..AlignOptions::default() };
        let looks = looks.map_or(options.looks, NonZeroUsize::get);
        let options = AlignOptions { looks, ..options };
        Ok(pix2pose.varied(options, aligns))
    }

    /// The model of a weight file with the default options.
    pub fn load(weights: &Path) -> Result<Pix2Pose> {
        let (model, options) = (Pix2PoseModel::load(weights)?, AlignOptions::default());
        Ok(Pix2Pose { model, options, aligns: true, outlines: Arc::default() })
    }

    /// The same model used in another way.
    pub fn varied(&self, options: AlignOptions, aligns: bool) -> Pix2Pose {
        Pix2Pose { model: self.model.clone(), options, aligns, outlines: self.outlines.clone() }
    }

    /// Most looks at an object.
    pub fn looks(&self) -> usize {
        self.options.looks
    }

    /// The network.
    pub fn model(&self) -> &Pix2PoseModel {
        &self.model
    }

    /// What the model knows of an object; without an id, of its only one.
    pub fn entry(&self, id: Option<u32>) -> Result<&ObjectEntry> {
        match (id, self.model.objects()) {
            (Some(id), _) => Ok(self.model.object(id)?.1),
            (None, [only]) => Ok(only),
            (None, several) => {
                let ids: Vec<String> = several.iter().map(|o| o.id.to_string()).collect();
                bail!("--object-id N is missing: the model knows the objects {}", ids.join(", "))
            }
        }
    }

    /// An error unless the mesh is that of the model's object `id`: same place and size in its frame.
    pub fn check_mesh(&self, id: u32, mesh: &Mesh, name: &str) -> Result<()> {
        self.entry(Some(id))?.check_mesh(mesh).with_context(|| name.to_owned())?;
        Ok(())
    }

    fn outline(&self, object_id: u32, mesh: &Mesh) -> Arc<Mesh> {
        let mut outlines = self.outlines.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        outlines.entry(object_id).or_insert_with(|| Arc::new(outline_mesh(mesh))).clone()
    }

    /// The best pose of an object in a box of a pinhole image, `None` if it is not seen there. Without a mesh the outline
    /// is not aligned.
    pub fn estimate(
        &self,
        image: &RgbImage,
        camera: &Camera,
        object_id: u32,
        region: &Rect,
        mesh: Option<&Mesh>,
    ) -> Result<Option<Pix2PosePose>> {
        if let (true, Some(mesh)) = (self.aligns, mesh) {
            let outline = self.outline(object_id, mesh);
            let (model, options) = (&self.model, &self.options);
            let aligned = estimate_aligned(model, image, camera, object_id, region, &outline, options)?;
            return Ok(aligned.map(|a| Pix2PosePose {
                camera_from_object: a.camera_from_object,
                score: a.score,
                refined: a.improved,
                found: a.found,
            }));
        }
        let Some(found) = estimate(&self.model, image, camera, object_id, region, &self.options.estimate)?
        else {
            return Ok(None);
        };
        let Some(best) = found.hypotheses.first() else { return Ok(None) };
        let (score, camera_from_object) = (best.score, best.camera_from_object);
        Ok(Some(Pix2PosePose { camera_from_object, score, refined: false, found }))
    }

    /// The pose brought to a depth image; `None` where too little depth is measured on the object. `mask` holds the pixels
    /// that may be the object's, if something says so.
    pub fn align(
        &self,
        depth: &DepthScene,
        object_id: u32,
        mesh: &Mesh,
        posed: &Pix2PosePose,
        mask: Option<&Mask>,
    ) -> Result<Option<AlignedToDepth>> {
        let diameter = self.entry(Some(object_id))?.diameter;
        Ok(depth.align(mesh, diameter, &posed.camera_from_object, &posed.found, mask).ok())
    }
}

/// Side of each of the four pictures beside one another.
const TILE: usize = 256;

/// What the network saw and said: input, coordinates (black where the object is not seen), expected error and visibility
/// (black 0, white 1), side by side.
pub fn view_picture(view: &View) -> RgbImage {
    let (input, p) = (&view.input, &view.prediction);
    let gap = 4;
    Image::from_fn(4 * TILE + 3 * gap, TILE, |x, y| {
        let (tile, x) = (x / (TILE + gap), x % (TILE + gap));
        if x >= TILE {
            return [255; 3];
        }
        let at = |side: usize| (x * side / TILE, y * side / TILE);
        let (px, py) = at(p.side);
        let index = py * p.side + px;
        let grey = |v: f32| [(255.0 * v).clamp(0.0, 255.0) as u8; 3];
        match tile {
            0 => {
                let (ix, iy) = (x * input.width() / TILE, y * input.height() / TILE);
                input[(ix, iy)]
            }
            1 if p.visible[index] > 0.5 => {
                p.coordinates[index].map(|v| (127.5 * (v + 1.0)).clamp(0.0, 255.0) as u8)
            }
            1 => [0; 3],
            2 => grey(p.error[index]),
            _ => grey(p.visible[index]),
        }
    })
}
