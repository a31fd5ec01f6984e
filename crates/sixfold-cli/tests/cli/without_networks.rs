//! The program without the feature `networks`: commands that need one are refused with the feature's name.

use crate::support::*;

#[test]
fn commands_that_need_networks_name_the_feature() {
    let case = OneImage::new();
    let mttm = "estimate --method mttm --depth depth.png --camera camera.json --object part.ply --unit mm";
    let mttm = |option: &str| format!("{mttm} {option}");
    let refused = [
        ("detect --weights detector.safetensors --rgb c.png --help".to_owned(), ""),
        ("train pix2pose --object part.ply --unit mm --out out".to_owned(), ""),
        ("synthesize --dataset tiny --out out".to_owned(), ""),
        (mttm("--matcher both"), "--matcher both"),
        (mttm("--masks network"), "--masks network"),
        (mttm("--matcher network --weights model.safetensors"), "--weights"),
    ];
    for (command, option) in refused {
        fails(case.path(), &command, &[option, "without the feature networks"]);
    }
    fails(case.path(), "estimate --method pix2pose", &["pix2pose", "--method"]);
    let help = sixfold(case.path(), "--help").expect(0).stdout;
    assert!(!help.contains("synthesize") && help.contains("estimate"), "{help}");
}
