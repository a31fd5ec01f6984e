//! What the weights that come with Sixfold are worth on objects that they were not trained on.

use std::path::Path;

use burn::tensor::Device;
use sixfold_dgcm::quality::quality;
use sixfold_dgcm::{GraspPoolOptions, Network, Pool};
use sixfold_nn::weights::load_weights;

#[test]
fn the_shipped_network_aligns_views_of_unknown_objects() {
    let file = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../weights/dgcm.safetensors"));
    let network = Network::of_architecture("dgcm-compact", &Device::flex()).unwrap();
    let (network, _) = load_weights(network, file, "dgcm-compact").unwrap();
    let pool =
        Pool::new(&GraspPoolOptions { views: 400, seed: 99, ..GraspPoolOptions::default() }, &()).unwrap();
    let quality = quality(&network, &pool, 160);
    println!("{quality:?}");
    assert!(quality.coordinates < 0.15, "{quality:?}");
    assert!(
        quality.coordinates < 0.8 * quality.decoded && quality.decoded < 0.7 * quality.own,
        "{quality:?}"
    );
}
