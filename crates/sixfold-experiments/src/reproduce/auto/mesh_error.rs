//! Meshes whose size is slightly off, as those of scanned objects are: without depth, a mesh that is two hundredths too large is found
//! two hundredths of the distance too far away, however well its outline fits.

use sixfold_geometry::Vec3;
use sixfold_geometry::random::{normal, stream};
use sixfold_mesh::{Mesh, MeshError, ModelInfo};

/// Largest error of a size, in standard deviations.
const MOST: f64 = 3.0;

/// Parses the standard deviation of the error of a size.
///
/// # Errors
/// What is wrong with it.
pub(super) fn parsed(text: &str) -> Result<f64, String> {
    let error = text.parse().ok().filter(|error: &f64| (0.0..=0.1).contains(error));
    error.ok_or_else(|| format!("found {text}, expected a fraction of the size, 0 to 0.1"))
}

/// The mesh with its extent along each axis of its frame multiplied by a factor: one plus a normal error of standard deviation `error`,
/// half of its variance common to the three axes. With it what `info` says of the mesh, and the same symmetries. Without error the same
/// mesh.
///
/// # Errors
/// [`MeshError`]; never for a whole mesh.
pub(super) fn with_error(
    mesh: Mesh,
    info: ModelInfo,
    error: f64,
    (seed, number): (u64, u64),
) -> Result<(Mesh, ModelInfo), MeshError> {
    if error == 0.0 {
        return Ok((mesh, info));
    }
    let mut random = stream(seed, number);
    let common = normal(&mut random);
    let factor = |own: f32| 1.0 + error * (f64::from(common + own) / 2.0_f64.sqrt()).clamp(-MOST, MOST);
    let factors = Vec3::from_fn(|_, _| factor(normal(&mut random)));
    let vertices = mesh.vertices().iter().map(|v| v.component_mul(&factors)).collect();
    let mut wrong = Mesh::new(vertices, mesh.faces().to_vec())?;
    if let Some(colors) = mesh.colors() {
        wrong = wrong.with_colors(colors.to_vec())?;
    }
    if let (Some(places), Some(texture)) = (mesh.texcoords(), mesh.texture()) {
        wrong = wrong.with_texture(places.to_vec(), texture.clone())?;
    }
    let ModelInfo { diameter, min, size, .. } = ModelInfo::of_mesh(&wrong);
    Ok((wrong, ModelInfo { diameter, min, size, ..info }))
}

#[cfg(test)]
mod tests {
    use sixfold_mesh::ContinuousSymmetry;

    use super::*;

    #[test]
    fn sizes_are_off_by_the_asked_standard_deviation_and_the_rest_is_kept() {
        let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let vertices = corners.map(Vec3::from).to_vec();
        let mesh = Mesh::new(vertices, vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]).unwrap();
        let mesh = mesh.with_colors(vec![[1, 2, 3]; 4]).unwrap();
        let turn = ContinuousSymmetry { axis: Vec3::z(), offset: Vec3::zeros() };
        let info = ModelInfo { symmetries_continuous: vec![turn], ..ModelInfo::of_mesh(&mesh) };
        assert_eq!(
            with_error(mesh.clone(), info.clone(), 0.0, (0, 1)).unwrap(),
            (mesh.clone(), info.clone())
        );
        let many: Vec<(Mesh, ModelInfo)> =
            (0..2000).map(|k| with_error(mesh.clone(), info.clone(), 0.02, (7, k)).unwrap()).collect();
        let moment = |of: &dyn Fn(Vec3) -> f64| {
            many.iter().map(|(_, i)| of(i.size.add_scalar(-1.0) / 0.02)).sum::<f64>() / many.len() as f64
        };
        let (mean, square, common) = (moment(&|e| e.x), moment(&|e| e.z * e.z), moment(&|e| e.x * e.y));
        assert!(mean.abs() < 0.1 && (square - 1.0).abs() < 0.1 && (common - 0.5).abs() < 0.1);
        let (wrong, other) = &many[0];
        assert_eq!((wrong.colors(), wrong.faces()), (mesh.colors(), mesh.faces()));
        assert_eq!(other.symmetries_continuous, info.symmetries_continuous);
        assert_eq!(other.diameter, wrong.diameter());
    }

    #[test]
    fn only_fractions_are_read() {
        assert_eq!(parsed("0.015"), Ok(0.015));
        for text in ["-0.01", "0.2", "nan", "x"] {
            assert!(parsed(text).unwrap_err().contains("expected a fraction of the size, 0 to 0.1"));
        }
    }
}
