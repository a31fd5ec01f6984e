//! An object as convex parts, which physics engines need for collisions: approximate convex decomposition by V-HACD (Mamou 2016,
//! "Volumetric hierarchical approximate convex decomposition", in Game Engine Gems 3), as implemented in the crate parry.

use rapier3d::math::Vector;
use rapier3d::parry::transformation::vhacd::{VHACD, VHACDParameters};
use rapier3d::parry::transformation::voxelization::FillMode;
use rapier3d::prelude::{Pose as RapierPose, SharedShape};
use sixfold_geometry::{Vec3, sphere_directions};
use sixfold_mesh::{Mesh, simplify};

use crate::SimulationError;
use crate::error::check_ranges;

/// Options of the convex decomposition.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartsOptions {
    /// Size of a voxel, metres; walls thinner than this are thickened to it.
    pub voxel: f64,
    /// Maximum number of parts.
    pub max_parts: usize,
    /// A part is split further when the volume of its hull exceeds its own by more than this fraction of the volume of the whole
    /// object's hull.
    pub concavity: f64,
    /// The mesh is first simplified to this number of faces.
    pub max_faces: usize,
}

impl Default for PartsOptions {
    fn default() -> Self {
        PartsOptions { voxel: 0.002, max_parts: 48, concavity: 0.004, max_faces: 8000 }
    }
}

impl PartsOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`SimulationError::Option`].
    pub fn check(&self) -> Result<(), SimulationError> {
        check_ranges(&[
            ("voxel", self.voxel, 0.0005, 0.05, "0.0005 to 0.05 m"),
            ("max_parts", self.max_parts as f64, 1.0, 1000.0, "1 to 1000"),
            ("concavity", self.concavity, 1e-5, 1.0, "0.00001 to 1"),
            ("max_faces", self.max_faces as f64, 4.0, 1e6, "4 to 1000000"),
        ])
    }
}

/// Convex parts of an object, in its own frame.
#[derive(Debug, Clone, PartialEq)]
pub struct ConvexParts {
    /// The vertices of each part's hull, metres.
    parts: Vec<Vec<Vec3>>,
}

impl ConvexParts {
    /// The object as one convex part: its hull.
    ///
    /// # Errors
    /// [`SimulationError::NoSolid`] when all vertices are in a plane.
    pub fn of_convex(mesh: &Mesh) -> Result<ConvexParts, SimulationError> {
        Self::from_points(vec![mesh.vertices().to_vec()], mesh)
    }

    /// The object decomposed into convex parts, so that hollows stay hollow. Takes seconds: keep the result.
    ///
    /// # Errors
    /// [`SimulationError::Option`], and [`SimulationError::NoSolid`] for a mesh without faces.
    pub fn of_mesh(mesh: &Mesh, options: &PartsOptions) -> Result<ConvexParts, SimulationError> {
        options.check()?;
        if mesh.faces().is_empty() {
            return Err(SimulationError::NoSolid {
                faces: 0,
                advice: "a list of points has no surface, give a mesh with faces",
            });
        }
        if is_convex(mesh) {
            return Self::of_convex(mesh);
        }
        let (low, high) = mesh.bounding_box();
        let simple;
        let mesh = if mesh.faces().len() > options.max_faces {
            simple = simplify(mesh, options.max_faces);
            &simple
        } else {
            mesh
        };
        let points: Vec<Vector> = mesh.vertices().iter().map(vector).collect();
        let parameters = VHACDParameters {
            resolution: ((high - low).amax() / options.voxel).ceil().clamp(24.0, 160.0) as u32,
            concavity: options.concavity as f32,
            max_convex_hulls: options.max_parts as u32,
            fill_mode: FillMode::FloodFill { detect_cavities: false },
            plane_downsampling: 4,
            ..VHACDParameters::default()
        };
        let decomposition = VHACD::decompose(&parameters, &points, mesh.faces(), true);
        let hulls = decomposition.compute_exact_convex_hulls(&points, mesh.faces());
        Self::from_points(
            hulls.into_iter().map(|(points, _)| points.iter().map(vec3).collect()).collect(),
            mesh,
        )
    }

    /// The hull vertices of all groups of points that have a volume.
    fn from_points(groups: Vec<Vec<Vec3>>, mesh: &Mesh) -> Result<ConvexParts, SimulationError> {
        let parts: Vec<Vec<Vec3>> = groups
            .into_iter()
            .filter(|points| points.len() >= 4)
            .filter_map(|points| {
                let points: Vec<Vector> = points.iter().map(vector).collect();
                let hull = SharedShape::convex_hull(&points)?;
                let corners = hull.as_convex_polyhedron()?.points();
                Some(corners.iter().map(vec3).collect())
            })
            .collect();
        if parts.is_empty() {
            return Err(SimulationError::NoSolid {
                faces: mesh.faces().len(),
                advice: "all vertices may lie in a plane, or the mesh is thinner than a voxel",
            });
        }
        Ok(ConvexParts { parts })
    }

    /// The hull vertices of each part, metres, in the object's frame.
    pub fn parts(&self) -> &[Vec<Vec3>] {
        &self.parts
    }

    /// The same with at most `most` vertices per part: the extreme ones in directions spread evenly over the sphere.
    pub(crate) fn thinned(&self, most: usize) -> ConvexParts {
        let thin = |part: &Vec<Vec3>| -> Vec<Vec3> {
            if part.len() <= most {
                return part.clone();
            }
            let farthest = |d: &Vec3| {
                (0..part.len()).max_by(|a, b| part[*a].dot(d).total_cmp(&part[*b].dot(d))).unwrap_or(0)
            };
            let mut kept: Vec<usize> = sphere_directions(most).iter().map(farthest).collect();
            kept.sort_unstable();
            kept.dedup();
            kept.into_iter().map(|i| part[i]).collect()
        };
        ConvexParts { parts: self.parts.iter().map(thin).collect() }
    }

    /// The engine's shape.
    pub(crate) fn shapes(&self) -> Vec<(RapierPose, SharedShape)> {
        self.parts
            .iter()
            .filter_map(|part| {
                let points: Vec<Vector> = part.iter().map(vector).collect();
                SharedShape::convex_hull(&points).map(|shape| (RapierPose::IDENTITY, shape))
            })
            .collect()
    }
}

/// Whether a closed mesh fills its hull to 97 % (scans are never exactly convex).
fn is_convex(mesh: &Mesh) -> bool {
    let volume = |mesh: &Mesh| -> f64 {
        (0..mesh.faces().len())
            .map(|face| {
                let [a, b, c] = mesh.triangle(face);
                a.dot(&b.cross(&c)) / 6.0
            })
            .sum()
    };
    mesh.convex_hull().is_ok_and(|hull| (0.97..=1.03).contains(&(volume(mesh).abs() / volume(&hull))))
}

/// To the engine's vector type.
pub(crate) fn vector(v: &Vec3) -> Vector {
    Vector::new(v.x as f32, v.y as f32, v.z as f32)
}

/// From the engine's vector type.
pub(crate) fn vec3(v: &Vector) -> Vec3 {
    Vec3::new(f64::from(v.x), f64::from(v.y), f64::from(v.z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_synth::primitives as shapes;

    #[test]
    fn a_bowl_stays_hollow_and_a_cube_is_one_part() {
        let bowl = shapes::bowl(0.07, 0.05, 0.004).unwrap();
        let parts = ConvexParts::of_mesh(&bowl, &PartsOptions::default()).unwrap();
        assert!(parts.parts().len() > 6, "{}", parts.parts().len());
        // No part's hull contains the centre of the hollow.
        let inside = Vec3::new(0.0, 0.0, 0.04);
        for (_, shape) in parts.shapes() {
            let reach = shape.as_convex_polyhedron().unwrap().aabb(&RapierPose::IDENTITY);
            let near = rapier3d::parry::query::PointQuery::contains_local_point(
                shape.as_convex_polyhedron().unwrap(),
                vector(&inside),
            );
            assert!(!near, "{reach:?}");
        }
        let cube = shapes::cuboid(Vec3::repeat(0.05)).unwrap();
        assert_eq!(ConvexParts::of_mesh(&cube, &PartsOptions::default()).unwrap().parts().len(), 1);
    }

    #[test]
    fn meshes_without_volume_are_refused() {
        let points = Mesh::new(vec![Vec3::x(), Vec3::y(), Vec3::z()], vec![]).unwrap();
        let error = ConvexParts::of_mesh(&points, &PartsOptions::default()).unwrap_err().to_string();
        assert!(error.contains("0 faces") && error.contains("mesh with faces"), "{error}");
        let options = PartsOptions { voxel: 2.0, ..PartsOptions::default() };
        let error = ConvexParts::of_mesh(&points, &options).unwrap_err().to_string();
        assert!(error.contains("voxel") && error.contains("found 2"), "{error}");
    }
}
