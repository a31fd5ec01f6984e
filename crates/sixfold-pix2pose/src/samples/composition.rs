//! From an object's image to an input image: background, clutter behind, occluders in front.

use rand::RngExt;
use sixfold_geometry::random::{Random, uniform};
use sixfold_synth::augment::{
    Backgrounds, Coverage, Cutout, Patch, Shape, occluder_of_fraction, procedural_texture,
};

use super::options::SampleOptions;

/// An image under construction and the part of the object that is still visible in it.
pub(super) struct Composition {
    pub image: Patch,
    pub visible: Coverage,
}

/// Data shared by all samples.
pub(super) struct Scenery<'a> {
    pub options: &'a SampleOptions,
    pub backgrounds: &'a Backgrounds,
    /// Images of objects, with the index of the object.
    pub cutouts: &'a [(usize, Cutout)],
    /// The object of the sample: its own images are not used.
    pub object_index: usize,
}

impl Scenery<'_> {
    fn background(&self, random: &mut Random) -> Patch {
        self.backgrounds.patch(self.options.size, self.options.size, random)
    }

    fn cutout(&self, random: &mut Random) -> Option<&Cutout> {
        // A few attempts find another object's image if there is one.
        (0..6).find_map(|_| {
            let (object, cutout) = self.cutouts.get(random.random_range(0..self.cutouts.len().max(1)))?;
            (*object != self.object_index).then_some(cutout)
        })
    }

    /// The object pasted on a background with clutter.
    pub(crate) fn paste(&self, object: &Patch, visible: Coverage, random: &mut Random) -> Composition {
        let size = self.options.size;
        let mut image = self.background(random);
        for _ in 0..random.random_range(0..=self.options.clutter) {
            let Some(cutout) = self.cutout(random) else { break };
            let side = size as f32;
            let centre = [random.random::<f32>() * side, random.random::<f32>() * side];
            let longest = side * uniform(random, [0.4, 0.95]);
            let turn = uniform(random, [-1.0, 1.0]) * self.options.rotation;
            let (mut patch, cover) = cutout.draw(size, size, centre, longest, turn);
            gain(&mut patch, uniform(random, [0.7, 1.3]));
            image.blend(&patch, &cover);
        }
        image.blend(object, &visible);
        image.soften_border(&visible, uniform(random, self.options.border_blur));
        Composition { image, visible }
    }

    /// A photograph without changes; the area outside it is grey or background.
    pub(crate) fn keep(
        &self,
        mut photograph: Patch,
        inside: &Coverage,
        visible: Coverage,
        random: &mut Random,
    ) -> Composition {
        let fill = random.random::<bool>();
        if fill && inside.data.iter().any(|v| *v < 0.5) {
            let mut background = self.background(random);
            background.blend(&photograph, inside);
            photograph = background;
        }
        Composition { image: photograph, visible }
    }

    /// Hides a part of the object behind shapes or images of other objects.
    pub(crate) fn occlude(&self, composition: &mut Composition, random: &mut Random) {
        let options = self.options;
        if random.random::<f32>() >= options.occlusion_probability {
            return;
        }
        let whole = uniform(random, options.occlusion);
        let parts = if random.random::<f32>() < 0.3 { 2 } else { 1 };
        for _ in 0..parts {
            let fraction = whole / parts as f32;
            let drawn = match self.cutout(random) {
                Some(cutout) if random.random::<f32>() < options.object_occluder_probability => {
                    let longest = options.size as f32 * uniform(random, [0.35, 0.9]);
                    cutout.draw_over(&composition.visible, fraction, longest, random).map(
                        |(mut patch, cover)| {
                            gain(&mut patch, uniform(random, [0.7, 1.3]));
                            (patch, cover)
                        },
                    )
                }
                _ => self.shape(&composition.visible, fraction, random),
            };
            let Some((patch, cover)) = drawn else { continue };
            composition.image.blend(&patch, &cover);
            if random.random::<f32>() < 0.5 {
                composition.image.soften_border(&cover, uniform(random, [0.3, 0.8]));
            }
            composition.visible.remove(&cover);
        }
    }

    /// Hides a part of the crop.
    pub(crate) fn hide(&self, composition: &mut Composition, cover: &Coverage, random: &mut Random) {
        composition.image.blend(&self.material(random), cover);
        composition.visible.remove(cover);
    }

    fn material(&self, random: &mut Random) -> Patch {
        let size = self.options.size;
        if self.options.background_occluders {
            return self.background(random);
        }
        match random.random_range(0..10u32) {
            0..=1 => Patch::filled(size, size, std::array::from_fn(|_| random.random())),
            2..=4 => procedural_texture(size, size, random),
            _ => self.background(random),
        }
    }

    fn shape(&self, visible: &Coverage, fraction: f32, random: &mut Random) -> Option<(Patch, Coverage)> {
        let size = self.options.size;
        // Centred on any pixel of the crop's central part, so on the object as often as at its border.
        let centre = [0, 1].map(|_| uniform(random, [0.1, 0.9]) * size as f32);
        let cover = occluder_of_fraction(&Shape::random(random), centre, visible, fraction)?;
        Some((self.material(random), cover))
    }
}

/// Multiplies all colours.
pub(super) fn gain(patch: &mut Patch, factor: f32) {
    patch.data.iter_mut().for_each(|v| *v = (*v * factor).min(1.0));
}
