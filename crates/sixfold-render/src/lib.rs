//! A CPU renderer: one pass fills a visibility buffer (inverse depth and triangle per pixel), and all outputs
//! (depth, masks, normals, object coordinates, barycentrics, colour) are read from it.
//!
//! Pixel centres lie at whole numbers, as in `sixfold-geometry`. Coverage is decided in integers on a
//! grid of 1/4096 pixel with the top-left fill rule, so triangles that share an edge never both cover a
//! pixel and never leave a gap. Depth is computed where the pixel's ray meets the triangle's plane, not
//! interpolated between rounded corners. The result is the same for any number of threads.

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod outputs;
mod portrait;
mod raster;
mod sensor;
mod shade;
mod shadow;
mod shadow_map;
mod table;

pub use outputs::{BoundingBoxScale, Surface};
pub use portrait::{portrait, portrait_camera, portrait_pose};
pub use raster::{Canvas, Culling, RenderOptions, SceneObject, VisibilityBuffer, render_depth};
pub use sensor::{DepthSensor, Draws, simulate_depth};
pub use shade::{Light, Material, shade, shade_in_shadows};
pub use shadow_map::ShadowMap;
pub use table::{DepthOnTable, depth_on_table, support_plane};
