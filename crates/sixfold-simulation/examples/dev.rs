//! dev
use sixfold_geometry::Vec3;
use sixfold_grasp::Gripper;
use sixfold_simulation::*;
use std::collections::BTreeMap;
fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let n: u64 = args[0].parse().unwrap();
    let gripper = Gripper::built_in("jaws-140").unwrap();
    let mut objects: Vec<(String, sixfold_mesh::Mesh)> = vec![];
    if args.len() == 1 {
        objects.push(("cube5".into(), shapes::cuboid(Vec3::repeat(0.05)).unwrap()));
        objects.push(("box".into(), shapes::cuboid(Vec3::new(0.06, 0.16, 0.2)).unwrap()));
        objects.push(("flatbox".into(), shapes::cuboid(Vec3::new(0.09, 0.13, 0.03)).unwrap()));
        objects.push(("bar".into(), shapes::cuboid(Vec3::new(0.18, 0.025, 0.022)).unwrap()));
        objects.push(("lying".into(), shapes::cylinder(0.018, 0.16).unwrap().transformed(&sixfold_geometry::Pose::exp(&[0.0, 0.0, 0.0, 0.0, 1.5707963, 0.0].into()))));
        objects.push(("bent".into(), sixfold_mesh::Mesh::merged(&[shapes::cuboid(Vec3::new(0.1, 0.03, 0.03)).unwrap(), shapes::cuboid(Vec3::new(0.1, 0.03, 0.03)).unwrap().transformed(&sixfold_geometry::Pose::exp(&[0.08, 0.025, 0.0, 0.0, 0.0, 0.6].into()))]).unwrap()));
        objects.push(("can".into(), shapes::cylinder(0.035, 0.1).unwrap()));
        objects.push(("bigcan".into(), shapes::cylinder(0.05, 0.14).unwrap()));
        objects.push(("bottle".into(), shapes::bottle(0.035, 0.2).unwrap()));
        objects.push(("cup".into(), shapes::cup(0.04, 0.1, 0.004).unwrap()));
        objects.push(("mug".into(), shapes::mug(0.042, 0.09, 0.005, 0.01).unwrap()));
        objects.push(("bowl".into(), shapes::bowl(0.07, 0.055, 0.005).unwrap()));
        objects.push(("bigbowl".into(), shapes::bowl(0.09, 0.06, 0.005).unwrap()));
    } else {
        let unit = if args[1] == "mm" { sixfold_mesh::Unit::Millimetre } else { sixfold_mesh::Unit::Metre };
        for p in &args[2..] { objects.push((p.rsplit('/').take(2).collect::<Vec<_>>().join(" "), sixfold_mesh::read_mesh(p, unit).unwrap())); }
    }
    let mut total = (0, 0);
    for (name, mesh) in objects {
        let t = std::time::Instant::now();
        let parts = ConvexParts::of_mesh(&mesh, &PartsOptions::default()).unwrap();
        let (lo, hi) = mesh.bounding_box();
        let cut = t.elapsed().as_secs_f64();
        let o = AttemptOptions { any_orientation: std::env::var("ANY").is_ok(), ..Default::default() };
        let mut ends: BTreeMap<String, usize> = BTreeMap::new();
        let (mut pt, mut tt, mut np) = (0.0f64, 0.0f64, 0);
        for k in 0..n {
            let a = attempt(&mesh, &parts, &gripper, &o, 1, k).unwrap();
            *ends.entry(format!("{:?}", a.ending)).or_default() += 1;
            pt = pt.max(a.planning_seconds); tt = tt.max(a.trial_seconds); np += a.proposals.len();
            if std::env::var("V").is_ok() { println!("  {k} {:?} q {:?} {:?}", a.ending, a.proposals.first().map(|g| (g.quality, g.opening)), a.report); }
            total.1 += 1; if a.ending.is_success() { total.0 += 1; }
        }
        println!("{name:30} size {:.3} {:.3} {:.3} parts {:3} ({cut:.1}s) plan {pt:.2}s trial {tt:.2}s proposals {:.0} {ends:?}", hi.x-lo.x, hi.y-lo.y, hi.z-lo.z, parts.parts().len(), np as f64 / n as f64);
    }
    println!("total {total:?}");
}
