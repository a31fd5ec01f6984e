//! Weight files whose cards hold numbers that cannot be: each is refused with file and field before a network of that size is made.

use burn::tensor::Device;
use serde_json::{Value, json};
use sixfold_detect::model::{ClassEntry, DetectorModel, DetectorUse};
use sixfold_detect::network::DetectorConfig;
use sixfold_nn::weights::{ModelCard, read_card, save_weights};

/// A change of the card, and words of the refusal.
type Case = (fn(&mut ModelCard), &'static [&'static str]);

#[test]
fn cards_with_impossible_numbers_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("model.safetensors");
    let config = DetectorConfig::compact(2);
    let network = config.init(0, &Device::flex());
    let classes = vec![ClassEntry { id: 5 }, ClassEntry { id: 8 }];
    let card = ModelCard::new("", "test");
    DetectorModel::new(network.clone(), config, classes, DetectorUse::default(), card).save(&file).unwrap();
    let whole = read_card(&file).unwrap();
    assert_eq!(DetectorModel::load(&file).unwrap().classes().len(), 2);
    let cases: &[Case] = &[
        (|c| c.extra["network"]["width"] = json!(0), &["`extra.network.width`", "found 0"]),
        (
            |c| c.extra["network"]["width"] = json!(1u64 << 63),
            &["`extra.network.width`", "9223372036854775808"],
        ),
        (|c| c.extra["network"]["width"] = json!(1024), &["`extra.network`", "that the file holds"]),
        (|c| c.extra["network"]["levels"] = json!(60), &["`extra.network.levels`", "2 to 6", "found 60"]),
        (
            |c| c.extra["network"]["shared"] = json!(u64::MAX),
            &["`extra.network.shared`", "18446744073709551615"],
        ),
        (|c| c.extra["network"]["own"] = json!(u64::MAX), &["`extra.network.own`"]),
        (|c| c.extra["network"]["own"] = json!(16), &["`extra.network`", "that the file holds"]),
        (|c| c.extra["network"]["prototypes"] = json!(0), &["`extra.network.prototypes`"]),
        (|c| c.extra["network"]["classes"] = json!(3), &["`extra.network.classes`", "3 for 2 objects"]),
        (|c| c.extra["network"] = Value::Null, &["`extra.network`"]),
        (|c| c.extra["use"]["longest_side"] = json!(0), &["`extra.use.longest_side`"]),
        (|c| c.extra["use"]["threshold"] = json!(1e39), &["`extra.use.threshold`", "found inf"]),
        (|c| c.extra["network"]["encoder"] = json!("res_net50"), &["`extra.network.encoder`"]),
        (|c| c.objects[1]["id"] = json!(5), &["`objects`", "every id once", "object 5 twice"]),
        (
            |c| {
                c.objects = (0..20_000).map(|id| json!({ "id": id })).collect();
                c.extra["network"]["classes"] = json!(20_000);
            },
            &["`extra.network.classes`", "1 to 10000", "20000"],
        ),
        (
            |c| {
                c.objects.clear();
                c.extra["network"]["classes"] = json!(0);
            },
            &["`extra.network.classes`", "found 0"],
        ),
        (|c| c.architecture = "detect".to_owned(), &["`architecture`", "found detect"]),
    ];
    for (change, words) in cases {
        let mut card = whole.clone();
        change(&mut card);
        save_weights(&network, &card, &file).unwrap();
        let error = DetectorModel::load(&file).unwrap_err().to_string();
        assert!(error.contains("model.safetensors"), "{error}");
        assert!(words.iter().all(|word| error.contains(word)), "{words:?} is not in {error}");
    }
}
