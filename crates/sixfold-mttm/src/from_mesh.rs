//! Templates rendered from a mesh.

use std::path::Path;

use rayon::prelude::*;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Pose, Vec2, Vec3};
use sixfold_io::Fnv1a;
use sixfold_mesh::{Mesh, simplify};
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use crate::error::{StoreError, TemplateError};
use crate::template::{
    ObjectTemplates, SIDE, Source, Template, TemplateOptions, central_pixel, patch_camera,
};
use crate::views::{view_directions, view_rotation};

/// More faces than this are finer than a template's pixels; chosen by hand, not swept.
const MAX_FACES: usize = 12_000;
/// Iterations of centring a view on the centre of its visible part: the perspective changes the visible part slightly each time.
/// Chosen by hand; not swept.
const CENTRINGS: usize = 3;
/// Largest difference between a length in a file and that of the mesh, as a fraction of the diameter: rounding errors.
const SAME_LENGTH: f64 = 1e-9;

impl ObjectTemplates {
    /// Renders `mesh` (metres) from all sides that the options request.
    ///
    /// # Errors
    /// [`TemplateError::Option`] and [`TemplateError::NoSurface`].
    pub fn from_mesh(mesh: &Mesh, options: &TemplateOptions) -> Result<ObjectTemplates, TemplateError> {
        options.check()?;
        if mesh.faces().is_empty() {
            return Err(TemplateError::NoSurface { faces: 0 });
        }
        let made_from = fingerprint(mesh, options);
        let diameter = mesh.diameter();
        let size = options.margin * diameter;
        let simple;
        let mesh = if mesh.faces().len() > MAX_FACES {
            simple = simplify(mesh, MAX_FACES);
            &simple
        } else {
            mesh
        };
        let templates: Vec<Template> = view_directions(options.coverage)
            .par_iter()
            .filter_map(|direction| draw(mesh, direction, size, options.distance))
            .collect();
        if templates.is_empty() {
            return Err(TemplateError::NoSurface { faces: mesh.faces().len() });
        }
        Ok(ObjectTemplates { diameter, size, options: *options, source: Source::Mesh, made_from, templates })
    }

    /// The templates of `mesh`: read from `path` if the file belongs to this mesh and these options, otherwise rendered and written
    /// there. The second value says why an existing file was not used or the new one could not be written.
    ///
    /// # Errors
    /// [`TemplateError`] as [`ObjectTemplates::from_mesh`].
    pub fn cached(
        path: &Path,
        mesh: &Mesh,
        options: &TemplateOptions,
    ) -> Result<(ObjectTemplates, Option<StoreError>), TemplateError> {
        let mut note = None;
        match ObjectTemplates::read(path) {
            Ok(templates) if templates.made_from == fingerprint(mesh, options) => {
                match templates.fits(mesh, options) {
                    Ok(()) => return Ok((templates, None)),
                    Err(what) => note = Some(StoreError::Damaged { path: path.into(), what }),
                }
            }
            Ok(_) => note = Some(StoreError::Damaged { path: path.into(), what: "made from another mesh" }),
            Err(StoreError::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => note = Some(error),
        }
        let templates = ObjectTemplates::from_mesh(mesh, options)?;
        if let Err(error) = templates.write(path) {
            note = Some(error);
        }
        Ok((templates, note))
    }
}

impl ObjectTemplates {
    /// Checks that the contents of a file fit the mesh from which it claims to be made.
    fn fits(&self, mesh: &Mesh, options: &TemplateOptions) -> Result<(), &'static str> {
        let (low, high) = mesh.bounding_box();
        // A view's reference point is on the mesh, so it is no further from the frame's origin than the furthest corner of the
        // bounding box.
        let reach = low.abs().sup(&high.abs()).norm() + self.diameter;
        if self.source != Source::Mesh || self.options != *options {
            return Err("field source or options: not those of the mesh's templates");
        }
        if (self.diameter - mesh.diameter()).abs() > SAME_LENGTH * self.diameter {
            return Err("field diameter: not that of the mesh");
        }
        if self.templates.len() > view_directions(options.coverage).len() {
            return Err("field templates: more than there are views");
        }
        if self.templates.iter().any(|t| t.view_from_object.translation().norm() > reach) {
            return Err("field view_from_object: a view that does not look at the mesh");
        }
        Ok(())
    }
}

/// FNV-1a over what templates depend on.
fn fingerprint(mesh: &Mesh, options: &TemplateOptions) -> u64 {
    let mut hash = Fnv1a::default();
    let mut add = |bytes: &[u8]| hash.write(bytes);
    add(options.coverage.name().as_bytes());
    add(&options.margin.to_le_bytes());
    add(&options.distance.to_le_bytes());
    mesh.vertices().iter().flat_map(|v| v.iter()).for_each(|c| add(&c.to_le_bytes()));
    mesh.faces().iter().flatten().for_each(|i| add(&i.to_le_bytes()));
    hash.value()
}

/// One view; `None` when nothing of the mesh is visible from there (a sheet seen edge-on).
fn draw(mesh: &Mesh, direction: &Vec3, size: f64, distance: f64) -> Option<Template> {
    draw_rotated(mesh, view_rotation(direction), size, distance)
}

/// The view in which the object is rotated by `rotation` (view from object).
pub(crate) fn draw_rotated(
    mesh: &Mesh,
    rotation: UnitQuaternion<f64>,
    size: f64,
    distance: f64,
) -> Option<Template> {
    let camera = patch_camera(size, distance);
    let mut frame = VisibilityBuffer::new(&camera);
    let (low, high) = mesh.bounding_box();
    // First centred on the bounding box, then on the visible part.
    let mut pose = Pose::new(rotation, Vec3::z() * distance - rotation * ((low + high) * 0.5));
    for _ in 0..CENTRINGS {
        frame.render(&[SceneObject { mesh, camera_from_object: pose }], &RenderOptions::default());
        let depth = frame.depth();
        let pixels: Vec<[usize; 2]> =
            (0..SIDE * SIDE).map(|i| [i % SIDE, i / SIDE]).filter(|&[x, y]| depth[(x, y)] > 0.0).collect();
        let [x, y] = central_pixel(&pixels)?;
        let seen = camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(depth[(x, y)]));
        pose = pose.with_translation(pose.translation() + Vec3::z() * distance - seen);
    }
    frame.render(&[SceneObject { mesh, camera_from_object: pose }], &RenderOptions::default());
    let depth = frame.depth();
    let stored =
        depth.as_slice().iter().map(|&z| if z > 0.0 { Template::stored(f64::from(z) - distance) } else { 0 });
    Some(Template {
        view_from_object: pose.with_translation(pose.translation() - Vec3::z() * distance),
        distance,
        depth: stored.collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A box of 6 x 8 x 10 cm, corner at the origin.
    fn brick() -> Mesh {
        const QUADS: [[u32; 4]; 6] =
            [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let size = [0.06, 0.08, 0.10];
        let vertices =
            (0..8).map(|i| Vec3::from_fn(|k, _| if i >> k & 1 == 1 { size[k] } else { 0.0 })).collect();
        let faces = QUADS.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
        Mesh::new(vertices, faces).unwrap()
    }

    #[test]
    fn every_point_of_a_template_is_on_the_mesh() {
        let templates = ObjectTemplates::from_mesh(&brick(), &TemplateOptions::default()).unwrap();
        assert_eq!(templates.templates.len(), 305);
        for t in templates.templates.iter().step_by(17) {
            let (cloud, _) = t.cloud(templates.size);
            assert!(cloud.len() > 200, "{}", cloud.len());
            let object_from_view = t.view_from_object.inverse();
            for p in &cloud.points {
                let p = object_from_view.transform_point(p);
                let off = |v: f64, top: f64| v.abs().min((v - top).abs());
                let surface = off(p.x, 0.06).min(off(p.y, 0.08)).min(off(p.z, 0.10));
                assert!(surface < 2e-4, "{p:?}");
            }
            // The reference point is visible and at the centre of the patch.
            assert!(t.relative_depth(SIDE / 2, SIDE / 2).is_some_and(|z| z.abs() < 0.01));
        }
    }

    #[test]
    fn kept_templates_are_taken_for_the_same_mesh_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("templates.bin");
        let options = TemplateOptions::default();
        let (first, note) = ObjectTemplates::cached(&path, &brick(), &options).unwrap();
        assert!(note.is_none() && path.is_file());
        let written = std::fs::metadata(&path).unwrap().modified().unwrap();
        let (again, note) = ObjectTemplates::cached(&path, &brick(), &options).unwrap();
        assert!(note.is_none());
        assert_eq!(first, again);
        assert_eq!(std::fs::metadata(&path).unwrap().modified().unwrap(), written);
        let (other, note) = ObjectTemplates::cached(&path, &brick().scaled(1.1), &options).unwrap();
        assert!(note.unwrap().to_string().contains("another mesh"));
        assert!((other.diameter / first.diameter - 1.1).abs() < 1e-9);
    }

    /// Files that claim to be intact, of this version and of this mesh.
    #[test]
    fn forged_templates_are_made_again_with_a_note_that_names_the_field() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("templates.bin");
        let options = TemplateOptions::default();
        let (honest, _) = ObjectTemplates::cached(&path, &brick(), &options).unwrap();
        type Forge = fn(&mut ObjectTemplates);
        let forgeries: [(&str, Forge); 11] = [
            ("diameter", |t| t.diameter = 0.0),
            ("diameter", |t| t.diameter = f64::NAN),
            ("diameter", |t| (t.diameter, t.size) = (2.0 * t.diameter, 2.0 * t.size)),
            ("size", |t| t.size *= 1e6),
            ("options", |t| t.options.margin = 1e300),
            ("source", |t| t.source = Source::Depth),
            ("templates", |t| t.templates = vec![t.templates[0].clone(); 5000]),
            ("templates", |t| t.templates.extend_from_within(..)),
            ("distance", |t| t.templates[7].distance = 1e200),
            ("view_from_object", |t| {
                t.templates[3].view_from_object = Pose::from_translation(Vec3::x() * 50.0);
            }),
            ("depth", |t| t.templates[5].depth.fill(0)),
        ];
        for (field, forge) in forgeries {
            let mut forged = honest.clone();
            forge(&mut forged);
            forged.write(&path).unwrap();
            let (templates, note) = ObjectTemplates::cached(&path, &brick(), &options).unwrap();
            let note = note.unwrap().to_string();
            assert!(note.contains(field) && note.contains("templates.bin"), "{field}: {note}");
            assert_eq!(templates, honest, "{field}");
        }
    }

    #[test]
    fn a_point_cloud_is_refused() {
        let points = Mesh::new(vec![Vec3::zeros(), Vec3::x(), Vec3::y()], vec![]).unwrap();
        let error = ObjectTemplates::from_mesh(&points, &TemplateOptions::default()).unwrap_err();
        assert_eq!(error, TemplateError::NoSurface { faces: 0 });
    }
}
