//! XYZ point lists: three numbers a line, optionally three more for the normal; `#` starts a comment.

use sixfold_geometry::Vec3;

use crate::error::MeshFileError;
use crate::file::Resources;
use crate::mesh::direction;
use crate::ply::excerpt;
use crate::{Mesh, Unit};

/// Reads a point list as a mesh without faces, in metres.
///
/// # Errors
/// [`MeshFileError::Field`] naming the line, [`MeshFileError::Mesh`] when there is no point.
pub fn parse_xyz(
    bytes: &[u8],
    file: &str,
    unit: Unit,
    _resources: Resources<'_>,
) -> Result<Mesh, MeshFileError> {
    let field = |line: usize, expected: &str, found: &str| MeshFileError::Field {
        file: file.to_owned(),
        field: format!("line {line}"),
        expected: expected.to_owned(),
        found: excerpt(found),
    };
    let text = std::str::from_utf8(bytes).map_err(|_| field(1, "text", "bytes that are no UTF-8"))?;
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    for (number, line) in text.lines().enumerate() {
        let content = line.split('#').next().unwrap_or_default().trim();
        if content.is_empty() {
            continue;
        }
        let values = content
            .split(|c: char| c.is_whitespace() || c == ',')
            .filter(|w| !w.is_empty())
            .map(str::parse::<f64>)
            .collect::<Result<Vec<_>, _>>()
            .map_err(|_| field(number + 1, "three or six numbers", content))?;
        match values[..] {
            [x, y, z] => points.push(Vec3::new(x, y, z) * unit.to_metres()),
            [x, y, z, a, b, c] => {
                points.push(Vec3::new(x, y, z) * unit.to_metres());
                normals.push(direction(&Vec3::new(a, b, c), 1e-9).unwrap_or_default());
            }
            _ => return Err(field(number + 1, "three or six numbers", content)),
        }
    }
    let wrap = |source| MeshFileError::Mesh { file: file.to_owned(), source };
    let count = points.len();
    let mesh = Mesh::new(points, vec![]).map_err(wrap)?;
    if normals.len() == count { mesh.with_normals(normals).map_err(wrap) } else { Ok(mesh) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::no_resources;

    #[test]
    fn points_are_read_and_bad_lines_named() {
        let mesh = parse_xyz(b"# head\n1 2 3\n\n4,5,6\n", "a.xyz", Unit::Millimetre, &no_resources).unwrap();
        assert_eq!(mesh.vertices(), &[Vec3::new(0.001, 0.002, 0.003), Vec3::new(0.004, 0.005, 0.006)]);
        let error =
            parse_xyz(b"1 2 3\n1 2 x\n", "a.xyz", Unit::Metre, &no_resources).unwrap_err().to_string();
        assert!(error.contains("a.xyz") && error.contains("line 2"), "{error}");
        assert!(parse_xyz(b"1 2\n", "a.xyz", Unit::Metre, &no_resources).is_err());
        assert!(parse_xyz(b"nan 0 0\n", "a.xyz", Unit::Metre, &no_resources).is_err());
        assert!(parse_xyz(b"", "a.xyz", Unit::Metre, &no_resources).is_err());
    }
}
