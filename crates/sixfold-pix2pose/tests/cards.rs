//! Weight files whose cards hold numbers that cannot be: each is refused with file and field before a network of that size is made.

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use serde_json::{Value, json};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::weights::{ModelCard, read_card, save_weights};
use sixfold_pix2pose::model::{ImageSizes, Network, Pix2PoseModel};
use sixfold_pix2pose::networks::{Compact, CompactConfig};
use sixfold_pix2pose::object::ObjectEntry;
use sixfold_render::BoundingBoxScale;

/// A whole model of two objects, with its network.
fn model(folder: &Path) -> (Compact, PathBuf) {
    let corners = [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.1, 0.05]].map(Into::into).to_vec();
    let info = ModelInfo::of_mesh(&Mesh::new(corners, vec![[0, 1, 2]]).unwrap());
    let scale = BoundingBoxScale::of_corners(&info.min, &(info.min + info.size));
    let entries = [5, 8].map(|id| ObjectEntry::new(id, &info, &scale)).to_vec();
    let network = CompactConfig { objects: 2 }.init_random(0, &Device::flex());
    let file = folder.join("model.safetensors");
    let card = ModelCard::new("", "test");
    let of = Network::Compact(Box::new(network.clone()));
    Pix2PoseModel::new(of, entries, ImageSizes::default(), card).save(&file).unwrap();
    (network, file)
}

/// A change of the card, and words of the refusal.
type Case = (fn(&mut ModelCard), &'static [&'static str]);

#[test]
fn cards_with_impossible_numbers_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (network, file) = model(folder.path());
    let whole = read_card(&file).unwrap();
    assert_eq!(Pix2PoseModel::load(&file).unwrap().objects().len(), 2);
    let cases: &[Case] = &[
        (|c| c.extra["image_sizes"]["input"] = json!(0), &["`extra.image_sizes`", "found 0 and 64"]),
        (|c| c.extra["image_sizes"]["input"] = json!(96), &["`extra.image_sizes`", "found 96 and 64"]),
        (
            |c| c.extra["image_sizes"]["output"] = json!(1u64 << 63),
            &["`extra.image_sizes`", "9223372036854775808"],
        ),
        (|c| c.extra["image_sizes"] = Value::Null, &["`extra.image_sizes`"]),
        (
            |c| c.objects[0]["thresholds"] = json!(vec![0.1; 3000]),
            &["`objects.thresholds`", "3000 thresholds", "object 5"],
        ),
        (|c| c.objects[0]["thresholds"] = json!([]), &["`objects.thresholds`", "0 thresholds"]),
        (|c| c.objects[0]["thresholds"] = json!([1e39]), &["`objects.thresholds`", "inf"]),
        (|c| c.objects[1]["diameter"] = json!(-1.0), &["`objects.diameter`", "found -1", "object 8"]),
        (|c| c.objects[1]["half_size"][2] = json!(0.0), &["`objects.half_size`"]),
        (|c| c.objects[1]["centre"][0] = json!(1e300), &["`objects.centre`"]),
        (|c| c.objects[1]["correction"]["depth"] = json!(1.0), &["`objects.correction`"]),
        (|c| c.objects[1]["id"] = json!(5), &["`objects`", "every id once", "object 5 twice"]),
        (|c| c.objects = vec![c.objects[0].clone(); 20_000], &["`objects`", "20000 in a file"]),
        (|c| c.objects = vec![c.objects[0].clone(); 900], &["`objects`", "900 in a file"]),
        (|c| c.objects.clear(), &["`objects`", "found 0 in a file"]),
        (|c| c.architecture = "pix2pose".to_owned(), &["`architecture`", "found pix2pose"]),
        (|c| c.architecture = "pix2pose-paper".to_owned(), &["`objects`", "one object", "found 2"]),
    ];
    for (change, words) in cases {
        let mut card = whole.clone();
        change(&mut card);
        save_weights(&network, &card, &file).unwrap();
        let error = Pix2PoseModel::load(&file).unwrap_err().to_string();
        assert!(error.contains("model.safetensors"), "{error}");
        assert!(words.iter().all(|word| error.contains(word)), "{words:?} is not in {error}");
    }
}
