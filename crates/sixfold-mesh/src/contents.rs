//! Hashes of the contents of meshes: equal for equal numbers, whichever file they come from, and different as soon as one number
//! changes. Used as keys of derived data and to compare inputs with those of an earlier run, see [`sixfold_io::Fnv1a`].

use sixfold_geometry::Vec3;
use sixfold_io::Fnv1a;

use crate::{Mesh, ModelInfo};

impl Mesh {
    /// The hash of vertices and faces.
    pub fn shape_hash(&self) -> u64 {
        let mut hash = Fnv1a::default();
        self.write_shape(&mut hash);
        hash.value()
    }

    /// The hash of everything: vertices, faces, normals, colours, texture.
    pub fn contents_hash(&self) -> u64 {
        let mut hash = Fnv1a::default();
        self.write_shape(&mut hash);
        // The kind and the count before each part distinguish a missing part from a different one.
        if let Some(normals) = self.normals() {
            begin(&mut hash, 1, normals.len());
            normals.iter().for_each(|normal| write_point(&mut hash, normal));
        }
        if let Some(colors) = self.colors() {
            begin(&mut hash, 2, colors.len());
            hash.write(colors.as_flattened());
        }
        if let Some(texcoords) = self.texcoords() {
            begin(&mut hash, 3, texcoords.len());
            texcoords.as_flattened().iter().for_each(|t| hash.write(&t.to_le_bytes()));
        }
        if let Some(texture) = self.texture() {
            begin(&mut hash, 4, texture.width());
            hash.write(texture.as_slice().as_flattened());
        }
        hash.value()
    }

    fn write_shape(&self, hash: &mut Fnv1a) {
        self.vertices().iter().for_each(|vertex| write_point(hash, vertex));
        self.faces().as_flattened().iter().for_each(|index| hash.write(&index.to_le_bytes()));
    }
}

impl ModelInfo {
    /// The hash of everything: diameter, bounding box, symmetries.
    pub fn contents_hash(&self) -> u64 {
        // Numbers print with all their digits.
        sixfold_io::fnv1a(format!("{self:?}").as_bytes())
    }
}

fn begin(hash: &mut Fnv1a, kind: u8, count: usize) {
    hash.write(&[kind]);
    hash.write(&(count as u64).to_le_bytes());
}

fn write_point(hash: &mut Fnv1a, point: &Vec3) {
    point.iter().for_each(|c| hash.write(&c.to_le_bytes()));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_of_a_mesh_counts() {
        let corners = || vec![Vec3::zeros(), Vec3::x(), Vec3::y(), Vec3::z()];
        let faces = || vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        let plain = Mesh::new(corners(), faces()).unwrap();
        let colored = Mesh::new(corners(), faces()).unwrap().with_colors(vec![[1, 2, 3]; 4]).unwrap();
        let other = Mesh::new(corners(), faces()).unwrap().with_colors(vec![[1, 2, 4]; 4]).unwrap();
        assert_eq!(plain.shape_hash(), colored.shape_hash());
        assert_ne!(plain.contents_hash(), colored.contents_hash());
        assert_ne!(colored.contents_hash(), other.contents_hash());
        let fewer = Mesh::new(corners(), faces()[..3].to_vec()).unwrap();
        let mut moved = corners();
        moved[3].z = 1.0 + f64::EPSILON;
        for shape in [fewer, Mesh::new(moved, faces()).unwrap()] {
            assert_ne!(shape.shape_hash(), plain.shape_hash());
            assert_ne!(shape.contents_hash(), plain.contents_hash());
        }
        let info = ModelInfo::of_mesh(&plain);
        let mut longer = info.clone();
        longer.diameter += 1e-15;
        assert_ne!(info.contents_hash(), longer.contents_hash());
    }
}
