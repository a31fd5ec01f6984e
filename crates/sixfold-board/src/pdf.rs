//! A PDF file of one page with black rectangles and text (ISO 32000-1).

use std::fmt::Write;

use crate::board::{Print, Text};

/// Points per metre.
const POINTS: f64 = 72.0 / 0.0254;

/// A page of a size in metres.
pub(crate) fn page((width, height): (f64, f64), print: &Print) -> Vec<u8> {
    let mut drawing = String::from("0 g\n");
    for [x, y, w, h] in &print.black {
        let (left, bottom) = (POINTS * x, POINTS * (height - y - h));
        // Writing to a string does not fail.
        let _ = writeln!(drawing, "{left:.4} {bottom:.4} {:.4} {:.4} re", POINTS * w, POINTS * h);
    }
    drawing.push_str("f\n");
    let Text { left, baseline, height: size, text } = &print.text;
    let escaped = text.replace('\\', "\\\\").replace('(', "\\(").replace(')', "\\)");
    let (left, bottom, points) = (POINTS * left, POINTS * (height - baseline), POINTS * size / 0.72);
    let _ = writeln!(drawing, "BT /F1 {points:.3} Tf {left:.3} {bottom:.3} Td ({escaped}) Tj ET");
    let (w, h) = (POINTS * width, POINTS * height);
    let objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>".to_owned(),
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>".to_owned(),
        format!(
            "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {w:.4} {h:.4}] /Contents 4 0 R \
             /Resources << /Font << /F1 5 0 R >> >> >>"
        ),
        format!("<< /Length {} >>\nstream\n{drawing}endstream", drawing.len()),
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>".to_owned(),
    ];
    let mut file = String::from("%PDF-1.4\n");
    let mut offsets = vec![];
    for (i, object) in objects.iter().enumerate() {
        offsets.push(file.len());
        let _ = write!(file, "{} 0 obj\n{object}\nendobj\n", i + 1);
    }
    let table = file.len();
    let _ = write!(file, "xref\n0 {}\n0000000000 65535 f \n", objects.len() + 1);
    for offset in offsets {
        let _ = writeln!(file, "{offset:010} 00000 n ");
    }
    let _ =
        write!(file, "trailer\n<< /Size {} /Root 1 0 R >>\nstartxref\n{table}\n%%EOF\n", objects.len() + 1);
    file.into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_points_to_the_objects() {
        let text = Text { left: 0.0, baseline: 0.1, height: 0.003, text: "a (b)".into() };
        let file = page((0.21, 0.297), &Print { black: vec![[0.0, 0.0, 0.0254, 0.0254]], text });
        let text = String::from_utf8(file).unwrap();
        assert!(text.contains("0.0000 769.8898 72.0000 72.0000 re"), "{text}");
        assert!(text.contains("(a \\(b\\)) Tj"));
        let start: usize =
            text.rsplit("startxref\n").next().unwrap().lines().next().unwrap().parse().unwrap();
        assert!(text[start..].starts_with("xref\n0 6\n"));
        for (i, line) in text[start..].lines().skip(3).take(5).enumerate() {
            let offset: usize = line[..10].parse().unwrap();
            assert!(text[offset..].starts_with(&format!("{} 0 obj", i + 1)), "{line}");
            assert_eq!(line.len(), 19);
        }
    }
}
