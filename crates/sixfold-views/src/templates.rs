//! Templates: an object rendered from all sides, each view as features and their points on the object.

use std::f64::consts::TAU;

use half::f16;
use rayon::prelude::*;
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::{Camera, KdTree, OptionError, Pose, Rect, RgbImage, Vec3};
use sixfold_mesh::{Mesh, simplify};
use sixfold_nn::xfeat::{CELL, CHANNELS, MULTIPLE};
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold_synth::augment::Patch;

use crate::colour::{Chroma, chromas, has_colours};
use crate::crop::Crop;
use crate::error::ViewsError;
use crate::features::{Extractor, FeatureMap};
use crate::network::input;
use crate::recognition::Appearance;

/// One view of an object.
#[derive(Debug, Clone)]
pub(crate) struct Template {
    /// From the object's frame to the crop's.
    pub crop_from_object: Pose,
    /// The crop's camera.
    pub camera: Camera,
    /// Cells whose feature is on the object.
    pub cells: Vec<u16>,
    /// Their features.
    pub features: Vec<f32>,
    /// Their points in the object's frame, metres.
    pub points: Vec<[f32; 3]>,
    /// Their colours; none if the object has no colours.
    pub chromas: Vec<Chroma>,
    /// By which the object is recognised; every second rotation has none.
    pub appearance: Appearance,
}

impl Template {
    /// The feature of the `i`-th cell.
    pub(crate) fn feature(&self, i: usize) -> &[f32] {
        &self.features[i * CHANNELS..(i + 1) * CHANNELS]
    }
}

/// An object rendered in one crop.
pub(crate) struct Rendered {
    /// Its colours, in front of `background`.
    pub image: RgbImage,
    /// The visible points in the object's frame; NaN where there are none.
    pub coordinates: sixfold_geometry::PointImage,
}

impl Rendered {
    /// Whether a pixel, by its number, shows the object.
    pub(crate) fn shows(&self, pixel: usize) -> bool {
        !self.coordinates.as_slice()[pixel][0].is_nan()
    }
}

/// The lamp for templates: at the camera.
pub(crate) fn head_light() -> Vec<Light> {
    vec![
        Light::Ambient { color: [0.35; 3] },
        Light::Directional { direction: Vec3::new(0.0, 0.0, 1.0), color: [0.65; 3] },
    ]
}

/// Renders an object into an image of its camera.
pub(crate) fn render(
    frame: &mut VisibilityBuffer,
    mesh: &Mesh,
    crop_from_object: &Pose,
    background: Option<&RgbImage>,
) -> Rendered {
    let objects = [SceneObject { mesh, camera_from_object: *crop_from_object }];
    frame.render(&objects, &RenderOptions::default());
    let image = shade(frame, &objects, &head_light(), &Material::default(), background);
    Rendered { image, coordinates: frame.object_coordinates(&objects) }
}

/// More faces than this are not visible in a crop; chosen by hand, not swept.
const MAX_FACES: usize = 12_000;

/// The mesh simplified to the faces that its views need, in the same colours: scans have tens of thousands, and rendering them
/// takes longer than everything else. A mesh with a texture is not simplified.
pub(crate) fn view_mesh(mesh: &Mesh) -> Mesh {
    if mesh.faces().len() <= MAX_FACES || mesh.texture().is_some() {
        return mesh.clone();
    }
    let simple = simplify(mesh, MAX_FACES);
    let normals = simple.vertex_normals();
    let Some(colors) = mesh.colors() else {
        return simple.clone().with_normals(normals).unwrap_or(simple);
    };
    let tree = KdTree::new(mesh.vertices());
    let nearest = |v: &Vec3| tree.nearest(v).and_then(|n| colors.get(n.index).copied()).unwrap_or_default();
    let own = simple.vertices().iter().map(nearest).collect();
    let coloured = simple.with_normals(normals).and_then(|m| m.with_colors(own));
    coloured.unwrap_or_else(|_| mesh.clone())
}

/// Difference in brightness of a template's background and the object.
const CONTRAST: f32 = 0.4;

/// The network's input for a render in front of plain grey that contrasts with the object.
pub(crate) fn input_over_grey(rendered: &Rendered) -> Vec<f32> {
    input(&over_grey(rendered))
}

/// The colour planes of a render in front of plain grey that contrasts with the object.
pub(crate) fn over_grey(rendered: &Rendered) -> Vec<f32> {
    let mut planes = Patch::from_rgb(&rendered.image).data;
    let area = planes.len() / 3;
    let hidden: Vec<bool> = rendered.coordinates.as_slice().iter().map(|p| p[0].is_nan()).collect();
    let (mut sum, mut count) = (0.0f64, 0usize);
    for plane in planes.chunks_exact(area.max(1)) {
        for (v, _) in plane.iter().zip(&hidden).filter(|(_, hidden)| !**hidden) {
            sum += f64::from(*v);
            count += 1;
        }
    }
    let mean = (sum / count.max(1) as f64) as f32;
    let grey = if mean > 0.5 { mean - CONTRAST } else { mean + CONTRAST };
    for plane in planes.chunks_exact_mut(area.max(1)) {
        plane.iter_mut().zip(&hidden).filter(|(_, hidden)| **hidden).for_each(|(v, _)| *v = grey);
    }
    planes
}

/// Ratio of a crop's side to the longer side of the object's box; the network was trained with it.
pub(crate) const CROP_FACTOR: f64 = 1.2;

/// A camera whose image shows the whole object from any side; only the object's box is taken from it.
pub(crate) fn wide_camera() -> Camera {
    Camera {
        fx: 600.0,
        fy: 600.0,
        cx: 127.5,
        cy: 127.5,
        width: 256,
        height: 256,
        distortion: Default::default(),
    }
}

/// Options of the templates.
#[derive(Debug, Clone, PartialEq)]
pub struct TemplateOptions {
    /// Number of viewing directions, spread evenly over the sphere.
    pub directions: usize,
    /// Number of in-plane rotations for each.
    pub rotations: usize,
    /// Side of a crop, pixels; a multiple of 32.
    pub side: usize,
    /// Ratio of a crop's side to the longer side of the object's box.
    pub crop_factor: f64,
    /// Distance of the camera as a multiple of the object's diameter.
    pub distance: f64,
}

/// On 86 targets of every ninth LM-O development frame 1500 templates of 192 pixels gave AR_MSSD / AR_MSPD / ADD(-S) recall
/// .424 / .666 / .209, these .447 / .642 / .302 in half the time.
impl Default for TemplateOptions {
    fn default() -> Self {
        TemplateOptions { directions: 80, rotations: 12, side: 160, crop_factor: CROP_FACTOR, distance: 6.0 }
    }
}

impl TemplateOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_within("templates.directions", self.directions, 1..=10_000, "1 to 10000")?;
        OptionError::unless_within("templates.rotations", self.rotations, 1..=360, "1 to 360")?;
        let fits = self.side.is_multiple_of(MULTIPLE) && (MULTIPLE..=512).contains(&self.side);
        if !fits {
            let expected = "a multiple of 32 from 32 to 512 pixels";
            return Err(OptionError::new("templates.side", self.side, expected));
        }
        OptionError::unless_positive("templates.crop_factor", self.crop_factor, "a number above 0")?;
        OptionError::unless_within("templates.distance", self.distance, 1.0..=1000.0, "1 to 1000 diameters")
    }
}

/// Directions spread evenly over the sphere (Fibonacci's lattice).
pub(crate) fn directions(count: usize) -> Vec<Vec3> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..count)
        .map(|i| {
            let z = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
            let r = (1.0 - z * z).max(0.0).sqrt();
            let angle = golden * i as f64;
            Vec3::new(r * angle.cos(), r * angle.sin(), z)
        })
        .collect()
}

/// The rotation of a camera that views an object from a direction, with the object's z axis up (if it is not along the view),
/// followed by an in-plane rotation.
pub(crate) fn rotation_from(direction: &Vec3, roll: f64) -> UnitQuaternion<f64> {
    let up = if direction.z.abs() > 0.999 { Vec3::y() } else { Vec3::z() };
    let z = -direction;
    let x = z.cross(&up).normalize();
    let y = z.cross(&x);
    let rows = sixfold_geometry::Mat3::from_rows(&[x.transpose(), y.transpose(), z.transpose()]);
    let camera_from_object = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows));
    UnitQuaternion::from_axis_angle(&Vec3::z_axis(), roll) * camera_from_object
}

/// The cells of a render whose feature is on the object, with their points.
pub(crate) fn cells_on_object(rendered: &Rendered, cells: usize) -> (Vec<u16>, Vec<[f32; 3]>) {
    let mut on = Vec::new();
    let mut points = Vec::new();
    for cell in 0..cells * cells {
        let (x, y) = (cell % cells * CELL, cell / cells * CELL);
        let point = rendered.coordinates[(x, y)];
        if !point[0].is_nan() {
            on.push(cell as u16);
            points.push(point);
        }
    }
    (on, points)
}

/// Renders an object from all sides; `mesh` should come from [`view_mesh`].
///
/// # Errors
/// [`ViewsError`].
pub(crate) fn make_templates(
    mesh: &Mesh,
    name: &str,
    diameter: f64,
    extractor: &Extractor,
    options: &TemplateOptions,
) -> Result<Vec<Template>, ViewsError> {
    let sides: Vec<(UnitQuaternion<f64>, bool)> = directions(options.directions)
        .iter()
        .flat_map(|direction| {
            (0..options.rotations).map(|k| {
                let roll = TAU * k as f64 / options.rotations as f64;
                (rotation_from(direction, roll), k.is_multiple_of(2))
            })
        })
        .collect();
    let wide = wide_camera();
    let mut templates = Vec::with_capacity(sides.len());
    // Inputs are large, so they are processed in chunks.
    for chunk in sides.chunks(CHUNK) {
        let rendered: Vec<(Template, Rendered, bool)> = chunk
            .par_iter()
            .map_init(
                || (VisibilityBuffer::new(&wide), VisibilityBuffer::new(&wide)),
                |frames, (rotation, recognised)| {
                    let (template, rendered) = render_side(frames, mesh, rotation, diameter, options)?;
                    Some((template, rendered, *recognised))
                },
            )
            .flatten()
            .collect();
        let planes: Vec<Vec<f32>> = rendered.iter().map(|(_, rendered, _)| over_grey(rendered)).collect();
        let inputs: Vec<Vec<f32>> = planes.iter().map(|planes| input(planes)).collect();
        let maps = extractor.features(&inputs, options.side)?;
        let shown = planes.iter().zip(&rendered).filter(|(_, (.., recognised))| *recognised);
        let shown: Vec<&[f32]> = shown.map(|(planes, _)| planes.as_slice()).collect();
        let mut seen = extractor.recogniser().features(&shown, options.side)?.into_iter();
        for ((mut template, rendered, recognised), map) in rendered.into_iter().zip(maps) {
            template.features = gathered(&map, &template.cells);
            if recognised && let Some(seen) = seen.next() {
                template.appearance = Appearance::new(&seen, |i| rendered.shows(i));
            }
            // Rounded as in the file, so that stored and new templates give the same poses.
            let colours = template.chromas.as_flattened_mut().iter_mut();
            let numbers =
                template.features.iter_mut().chain(&mut template.appearance.features).chain(colours);
            numbers.for_each(|v| *v = f16::from_f32(*v).to_f32());
            templates.push(template);
        }
    }
    if templates.iter().all(|t| t.cells.is_empty()) {
        return Err(ViewsError::Invisible { object: name.to_owned() });
    }
    Ok(templates)
}

/// Number of templates rendered at a time, before their features are computed.
const CHUNK: usize = 64;

/// A template without features, and its render; `None` for a side from which nothing is visible.
fn render_side(
    frames: &mut (VisibilityBuffer, VisibilityBuffer),
    mesh: &Mesh,
    rotation: &UnitQuaternion<f64>,
    diameter: f64,
    options: &TemplateOptions,
) -> Option<(Template, Rendered)> {
    let away = options.distance * diameter;
    let (crop_from_object, rendered) =
        side_view(frames, mesh, rotation, away, options.crop_factor, options.side)?;
    let (cells, points) = cells_on_object(&rendered, options.side / CELL);
    let mut colours = Vec::new();
    if has_colours(mesh) {
        let all = chromas(&Patch::from_rgb(&rendered.image).data, options.side, |i| rendered.shows(i));
        colours = cells.iter().map(|cell| all[usize::from(*cell)]).collect();
    }
    let template = Template {
        crop_from_object,
        camera: *frames.1.camera(),
        cells,
        features: vec![],
        points,
        chromas: colours,
        appearance: Appearance::default(),
    };
    Some((template, rendered))
}

/// The object rendered from one side by a camera `away` metres from its centre, in a square image of `side` pixels, which is
/// `factor` times as large as the object's box; `frames` are buffers, the second one with the camera of the result. `None` for a side from
/// which nothing is visible.
pub(crate) fn side_view(
    (wide, close): &mut (VisibilityBuffer, VisibilityBuffer),
    mesh: &Mesh,
    rotation: &UnitQuaternion<f64>,
    away: f64,
    factor: f64,
    side: usize,
) -> Option<(Pose, Rendered)> {
    let (low, high) = mesh.bounding_box();
    let pose = Pose::new(*rotation, Vec3::new(0.0, 0.0, away) - rotation * ((low + high) * 0.5));
    wide.render(&[SceneObject { mesh, camera_from_object: pose }], &RenderOptions::default());
    let bbox: Rect = wide.bounding_box()?;
    let crop = Crop::of_box(wide.camera(), &bbox, factor, side)?;
    close.set_camera(&crop.camera);
    let crop_from_object = crop.to_crop(&pose);
    let rendered = render(close, mesh, &crop_from_object, None);
    Some((crop_from_object, rendered))
}

/// The features of some cells.
pub(crate) fn gathered(map: &FeatureMap, cells: &[u16]) -> Vec<f32> {
    cells.iter().flat_map(|c| map.feature(usize::from(*c)).iter().copied()).collect()
}
