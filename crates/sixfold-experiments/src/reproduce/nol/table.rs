//! The tables as one page of markdown.

use std::fmt::Write;

use super::Whole;
use super::poses::PosesSummary;
use super::views::{MOVED, ViewsSummary};

pub(super) fn markdown(whole: &Whole) -> String {
    let i = &whole.inputs;
    let mut out = format!(
        "# Neural Object Learning: {} frames of `{}`\n\nPoses disturbed by up to {:.0} mm along and {} rad \
         about each axis, {} time(s).{}\n",
        i.frames.len(),
        i.dataset,
        1e3 * super::material::REACH[0],
        super::material::REACH[1],
        whole.disturbances,
        if whole.quick { " **Quick: one disturbance, a quarter of the views.**" } else { "" }
    );
    out += "\n## Poses\n\nMedians over photographs of objects: error of the centre of the object's box, \
        across and along the optical axis; the angle; the fraction whose box came nearer to the annotated \
        one. The last row is the difference between annotations and photographs: no refinement can be \
        nearer to the annotations than the photographs are.\n";
    poses(&mut out, &whole.poses);
    out += "\n## Poses of rendered frames\n\nThe same frames, poses and disturbances with exact poses: the \
        coloured models rendered over other frames' photographs, light and colours changed from frame to \
        frame.\n";
    poses(&mut out, &whole.drawn_poses);
    views(&mut out, &whole.views, &whole.targets_of_views);
    if !whole.lamps.is_empty() {
        out += "\n## Another lamp\n\nThe same scene under several lamps, photographed by a static camera: \
            each photograph is predicted from the others. No method here knows the lamp, so compare the \
            columns *in its light*.\n";
        measures(&mut out, &whole.lamps);
    }
    let s = &whole.speed;
    let _ = writeln!(
        out,
        "\n## Time\n\nObject {}, {} photographs, {} threads, {}x{} pixels. Refinement of these photographs \
         alone: {:.1} s. Before the first view: {:.1} s.\n",
        s.object, s.sources, s.threads, s.side, s.side, s.refinement, s.preparation
    );
    out += "| | seconds per view | photographs used |\n|---|---|---|\n";
    for v in &s.views {
        let _ = writeln!(out, "| {} | {:.2} | {:.1} |", v.method, v.seconds, v.sources);
    }
    out
}

fn poses(out: &mut String, rows: &[PosesSummary]) {
    *out += "\n| | photographs | mm | across | along | degrees | nearer | dropped | s, all objects of all frames |\n|---|---|---|---|---|---|---|---|---|\n";
    for r in rows {
        let a = &r.all;
        let seconds = r.seconds.map_or("-".to_owned(), |s| format!("{s:.0}"));
        let nearer = a.improved.filter(|_| r.seconds.is_some());
        let nearer = nearer.map_or("-".to_owned(), |fraction| format!("{:.0} %", 100.0 * fraction));
        let _ = writeln!(
            out,
            "| {} | {} | {:.2} | {:.2} | {:.2} | {:.2} | {nearer} | {} | {seconds} |",
            r.title,
            a.sources,
            a.millimetres,
            a.millimetres_across,
            a.millimetres_along,
            a.degrees,
            r.dropped
        );
    }
    *out += "\nPer object: mm / degrees\n\n| object | photographs |";
    for r in rows {
        let _ = write!(out, " {} |", r.title);
    }
    let _ = writeln!(out, "\n|---|---|{}", "---|".repeat(rows.len()));
    for (id, first) in rows.first().map(|r| &r.objects).into_iter().flatten() {
        let _ = write!(out, "| {id} | {} |", first.sources);
        for r in rows {
            match r.objects.get(id) {
                Some(m) => {
                    let _ = write!(out, " {:.2} / {:.2} |", m.millimetres, m.degrees);
                }
                None => *out += " - |",
            }
        }
        out.push('\n');
    }
}

fn views(out: &mut String, rows: &[ViewsSummary], targets: &[usize; 2]) {
    let _ = writeln!(
        out,
        "\n## Views\n\n{} targets in frames that are no sources, at their ground-truth poses, compared with \
         the photograph ({} more were left out: too few pixels that all methods show). Compared where the \
         object is visible and every method shows it. Things in front of the object that the ground truth \
         does not name count against all. PSNR in dB; SSIM; perceptual: mean squared difference of the \
         first three EfficientNet-Lite0 features, each normalised to length 1 at every pixel, without \
         learned weights. *In its light*: after the gain and offset per channel that fit best. *And \
         place*: also shifted, by up to {} pixels along each axis, to where it fits best, away from the \
         object's border: annotated poses of targets have errors of pixels. *Better*: fraction of the \
         targets on which the perceptual distance is smaller than averaging's from the same photographs. \
         *Unseen*: fraction of the object that no photograph used for the view shows. *Agreeing*: pixels \
         of a photograph that contradict the other photographs are removed before (things in front of the \
         object that no mask excludes). *500 faces* and *vertices 1 mm off*: ground-truth poses with a \
         simplified mesh, and with vertices moved by N(0, 1 mm) along each axis.",
        targets[0], targets[1], MOVED
    );
    measures(out, rows);
}

fn measures(out: &mut String, rows: &[ViewsSummary]) {
    *out += "\n| from | | targets | PSNR | SSIM | perceptual | in its light: PSNR | SSIM | perceptual | and place: PSNR | SSIM | perceptual | better | unseen |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n";
    for r in rows {
        let better = r.better_than_average.map_or("-".to_owned(), |b| format!("{:.0} %", 100.0 * b));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {:.2} | {:.3} | {:.4} | {:.2} | {:.3} | {:.4} | {:.2} | {:.3} | {:.4} | {better} | {:.1} % |",
            r.set,
            r.method,
            r.targets,
            r.plain.psnr,
            r.plain.ssim,
            r.plain.perceptual,
            r.lit.psnr,
            r.lit.ssim,
            r.lit.perceptual,
            r.placed.psnr,
            r.placed.ssim,
            r.placed.perceptual,
            100.0 * r.unseen
        );
    }
}
