//! Prints the tags of images as JSON: `cargo run --release -p sixfold-board --example tags -- IMAGE...`.

use std::collections::BTreeMap;
use std::path::Path;

use sixfold_board::detect_tags;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut all = BTreeMap::new();
    for file in std::env::args().skip(1) {
        let found = detect_tags(&sixfold_io::read_rgb(Path::new(&file))?);
        let tags: Vec<_> = found
            .tags
            .iter()
            .map(|t| serde_json::json!({ "id": t.id, "corners": t.corners.map(|c| [c.x, c.y]), "edge_width": t.edge_width }))
            .collect();
        all.insert(file, tags);
    }
    println!("{}", serde_json::to_string_pretty(&all)?);
    Ok(())
}
