//! Compressed masks: no text may make the decoder panic, and what decodes must encode to itself.
#![no_main]

use sixfold_bop::Rle;

libfuzzer_sys::fuzz_target!(|input: (u8, u8, &str)| {
    let (width, height, text) = input;
    if let Ok(rle) = Rle::from_compressed(width.into(), height.into(), text) {
        let again = Rle::from_compressed(width.into(), height.into(), &rle.to_compressed());
        assert_eq!(again.as_ref(), Ok(&rle));
        let mask = rle.decode();
        let area = mask.as_slice().iter().filter(|p| **p).count();
        assert_eq!(area as u64, rle.area());
        assert_eq!(rle.intersection(&rle), Some(rle.area()));
    }
});
