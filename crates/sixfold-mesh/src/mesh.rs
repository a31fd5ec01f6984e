//! The triangle mesh that all other crates use: checked once, in metres.

use std::collections::HashSet;

use sixfold_geometry::{RgbImage, Vec3};
use thiserror::Error;

use crate::MeshFileError;
use crate::measure::{computed_normals, position_key};

/// Why arrays do not form a mesh.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum MeshError {
    /// There are no vertices.
    #[error("the mesh has no vertices")]
    Empty,
    /// A coordinate is NaN or infinite.
    #[error("vertex {index} is not finite: {found:?}")]
    NotFinite {
        /// Index of the vertex.
        index: usize,
        /// Its coordinates.
        found: [f64; 3],
    },
    /// A face refers to a vertex that does not exist.
    #[error("face {face} names vertex {found}, the mesh has {vertices} vertices")]
    FaceIndex {
        /// Index of the face.
        face: usize,
        /// The vertex index found.
        found: u32,
        /// How many vertices there are.
        vertices: usize,
    },
    /// An attribute has another length than the vertices.
    #[error("{attribute}: {found} entries for {vertices} vertices")]
    AttributeLength {
        /// Name of the attribute.
        attribute: &'static str,
        /// Entries found.
        found: usize,
        /// How many vertices there are.
        vertices: usize,
    },
}

/// A triangle mesh in its object's frame, in metres. A mesh without faces is a point model.
///
/// Texture coordinates are per vertex (readers split vertices at seams): `u` to the right, `v` up, the
/// origin at the bottom left of the texture, as OBJ and PLY have it.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    vertices: Vec<Vec3>,
    faces: Vec<[u32; 3]>,
    normals: Option<Vec<Vec3>>,
    colors: Option<Vec<[u8; 3]>>,
    texcoords: Option<Vec<[f32; 2]>>,
    texture: Option<RgbImage>,
}

impl Mesh {
    /// A mesh from vertices in metres and triangles.
    ///
    /// # Errors
    /// [`MeshError`] when there is no vertex, a coordinate is not finite or a face refers to a missing vertex.
    pub fn new(vertices: Vec<Vec3>, faces: Vec<[u32; 3]>) -> Result<Self, MeshError> {
        if vertices.is_empty() {
            return Err(MeshError::Empty);
        }
        if let Some(index) = vertices.iter().position(|v| !v.iter().all(|c| c.is_finite())) {
            let v = vertices[index];
            return Err(MeshError::NotFinite { index, found: [v.x, v.y, v.z] });
        }
        for (face, corners) in faces.iter().enumerate() {
            if let Some(&found) = corners.iter().find(|&&i| i as usize >= vertices.len()) {
                return Err(MeshError::FaceIndex { face, found, vertices: vertices.len() });
            }
        }
        Ok(Mesh { vertices, faces, normals: None, colors: None, texcoords: None, texture: None })
    }

    fn check_length(&self, attribute: &'static str, found: usize) -> Result<(), MeshError> {
        if found == self.vertices.len() {
            return Ok(());
        }
        Err(MeshError::AttributeLength { attribute, found, vertices: self.vertices.len() })
    }

    /// With unit normals, one per vertex; zero where unknown.
    ///
    /// # Errors
    /// [`MeshError::AttributeLength`].
    pub fn with_normals(mut self, normals: Vec<Vec3>) -> Result<Self, MeshError> {
        self.check_length("normals", normals.len())?;
        self.normals = Some(normals);
        Ok(self)
    }

    /// With colours, one per vertex, sRGB.
    ///
    /// # Errors
    /// [`MeshError::AttributeLength`].
    pub fn with_colors(mut self, colors: Vec<[u8; 3]>) -> Result<Self, MeshError> {
        self.check_length("colors", colors.len())?;
        self.colors = Some(colors);
        Ok(self)
    }

    /// With a texture and its coordinates, one per vertex.
    ///
    /// # Errors
    /// [`MeshError::AttributeLength`].
    pub fn with_texture(mut self, texcoords: Vec<[f32; 2]>, texture: RgbImage) -> Result<Self, MeshError> {
        self.check_length("texcoords", texcoords.len())?;
        self.texcoords = Some(texcoords);
        self.texture = Some(texture);
        Ok(self)
    }

    /// Vertices in metres.
    pub fn vertices(&self) -> &[Vec3] {
        &self.vertices
    }

    /// Triangles as vertex indices, counter-clockwise seen from outside.
    pub fn faces(&self) -> &[[u32; 3]] {
        &self.faces
    }

    /// Unit normals per vertex, when known; an unknown normal of a single vertex is zero.
    pub fn normals(&self) -> Option<&[Vec3]> {
        self.normals.as_deref()
    }

    /// Colours per vertex, when known.
    pub fn colors(&self) -> Option<&[[u8; 3]]> {
        self.colors.as_deref()
    }

    /// Texture coordinates per vertex, when known.
    pub fn texcoords(&self) -> Option<&[[f32; 2]]> {
        self.texcoords.as_deref()
    }

    /// The texture, when there is one.
    pub fn texture(&self) -> Option<&RgbImage> {
        self.texture.as_ref()
    }

    /// The mesh without repeated faces, that is, faces with the same three vertices in any order. The first of them stays.
    pub fn without_repeated_faces(&self) -> Mesh {
        let mut seen = HashSet::with_capacity(self.faces.len());
        let place = |i: u32| position_key(&self.vertices[i as usize]);
        let first = |face: &&[u32; 3]| {
            let mut corners = face.map(place);
            corners.sort_unstable();
            seen.insert(corners)
        };
        Mesh { faces: self.faces.iter().filter(first).copied().collect(), ..self.clone() }
    }

    /// A mesh with its vertices and normals mapped; faces, colours and texture stay.
    pub(crate) fn map_geometry(
        &self,
        vertex: impl Fn(&Vec3) -> Vec3,
        normal: impl Fn(&Vec3) -> Vec3,
    ) -> Mesh {
        Mesh {
            vertices: self.vertices.iter().map(vertex).collect(),
            normals: self.normals.as_ref().map(|normals| normals.iter().map(normal).collect()),
            ..self.clone()
        }
    }

    /// All faces of several meshes in one; vertices follow in order. Normals, colours and texture coordinates are kept if all
    /// parts have them. If only some parts have normals, the others' are computed; if only some have colours, the others
    /// become grey. A texture is kept only if all parts share it.
    ///
    /// # Errors
    /// [`MeshError::Empty`] without any part.
    pub fn merged(parts: &[Mesh]) -> Result<Mesh, MeshError> {
        let first = parts.first().ok_or(MeshError::Empty)?;
        let mut vertices = Vec::new();
        let mut faces = Vec::new();
        for part in parts {
            let offset = vertices.len() as u32;
            vertices.extend_from_slice(&part.vertices);
            faces.extend(part.faces.iter().map(|face| face.map(|i| i + offset)));
        }
        let mut mesh = Mesh::new(vertices, faces)?;
        if parts.iter().any(|part| part.normals.is_some()) {
            mesh.normals = Some(parts.iter().flat_map(Mesh::vertex_normals).collect());
        }
        if parts.iter().any(|part| part.colors.is_some()) {
            let colors = parts.iter().flat_map(|part| match &part.colors {
                Some(colors) => colors.clone(),
                None => vec![[128; 3]; part.vertices.len()],
            });
            mesh.colors = Some(colors.collect());
        }
        if first.texture.is_some() && parts.iter().all(|part| part.texture == first.texture) {
            mesh.texcoords = parts
                .iter()
                .map(|part| part.texcoords.clone())
                .collect::<Option<Vec<_>>>()
                .map(|t| t.concat());
            mesh.texture = first.texture.clone().filter(|_| mesh.texcoords.is_some());
        }
        Ok(mesh)
    }
}

/// A unit vector; `None` if the length is `minimum` or less, not finite, or too large to be computed.
pub(crate) fn direction(vector: &Vec3, minimum: f64) -> Option<Vec3> {
    vector.try_normalize(minimum).filter(|n| (n.norm() - 1.0).abs() < 1e-6)
}

/// The content of a file before it is checked.
#[derive(Debug, Default)]
pub(crate) struct Parts {
    /// In metres.
    pub vertices: Vec<Vec3>,
    pub faces: Vec<[u32; 3]>,
    /// As in the file: of any length, possibly zero or NaN.
    pub normals: Option<Vec<Vec3>>,
    pub colors: Option<Vec<[u8; 3]>>,
    pub texcoords: Option<Vec<[f32; 2]>>,
    pub texture: Option<RgbImage>,
}

impl Parts {
    /// The checked mesh. Normals are normalised; a normal without a direction is computed from the faces.
    pub(crate) fn into_mesh(self, file: &str) -> Result<Mesh, MeshFileError> {
        let in_file = |source| MeshFileError::Mesh { file: file.to_owned(), source };
        let mut mesh = Mesh::new(self.vertices, self.faces).map_err(in_file)?;
        if let Some(mut normals) = self.normals {
            mesh.check_length("normals", normals.len()).map_err(in_file)?;
            let mut missing = false;
            for normal in &mut normals {
                let unit = direction(normal, 1e-12);
                missing |= unit.is_none();
                *normal = unit.unwrap_or_default();
            }
            if missing {
                let computed = computed_normals(&mesh.vertices, &mesh.faces);
                for (normal, computed) in normals.iter_mut().zip(computed) {
                    if *normal == Vec3::zeros() {
                        *normal = computed;
                    }
                }
            }
            mesh.normals = Some(normals);
        }
        if let Some(colors) = self.colors {
            mesh = mesh.with_colors(colors).map_err(in_file)?;
        }
        if let (Some(texcoords), Some(texture)) = (self.texcoords, self.texture) {
            mesh = mesh.with_texture(texcoords, texture).map_err(in_file)?;
        }
        Ok(mesh)
    }
}
