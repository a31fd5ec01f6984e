//! The triangle mesh every other crate works on: checked once, in metres.

use sixfold_geometry::{RgbImage, Vec3};
use thiserror::Error;

/// Why arrays do not form a mesh.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum MeshError {
    /// There is not a single vertex.
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
    /// A face names a vertex that does not exist.
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
    /// [`MeshError`] when there is no vertex, a coordinate is not finite or a face names a missing vertex.
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

    /// With unit normals, one per vertex.
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

    /// Unit normals per vertex, when known.
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
}
