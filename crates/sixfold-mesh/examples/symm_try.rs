#![allow(missing_docs)]
use sixfold_mesh::*;
fn main() {
    let noise: f64 = std::env::var("NOISE").ok().map_or(0.0, |v| v.parse().unwrap());
    for a in std::env::args().skip(1) {
        let (path, unit) = a.split_once(':').unwrap_or((&a, "mm"));
        let mesh = read_mesh(path, unit.parse().unwrap()).unwrap();
        let t = std::time::Instant::now();
        let found = find_symmetries(&mesh, &SymmetryOptions { noise, ..Default::default() }).unwrap();
        println!("{path}: {} faces, diameter {:.1}, {:?}", mesh.faces().len(), 1e3 * mesh.diameter(), t.elapsed());
        for s in found {
            println!("   {:?} axis {:.3?} point {:.1?} p95 {:.2} mm {:.4} max {:.2} mm {:.4} color {:?} {} {}", s.order, s.axis.as_slice(),
              (s.point * 1e3).as_slice(), s.deviation.p95 * 1e3, s.deviation.p95 / s.diameter, s.deviation.max * 1e3, s.deviation.max / s.diameter,
              s.color.map(|c| (c.mean, c.p95)), s.by_shape.name(), s.by_shape_and_color.name());
        }
    }
}
