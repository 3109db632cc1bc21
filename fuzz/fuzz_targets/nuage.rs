//! Any bytes as a packed file: an error or an asset whose every brick decodes or is an error, never a panic.
#![no_main]

use nuage_volume::format::{Asset, FormatError, Limits, reseal};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    // With right checksums, or nothing behind them would be reached.
    let mut bytes = bytes.to_vec();
    reseal(&mut bytes);
    let limits = Limits { max_memory_bytes: 32 << 20 };
    let mut asset = match Asset::open_with(bytes, limits) {
        Ok(asset) => asset,
        Err(FormatError::Malformed { .. } | FormatError::Unsupported { .. } | FormatError::Limit { .. }) => return,
        Err(error) => panic!("not the file's fault: {error:?}"),
    };
    let loaded = asset.load_all().is_ok();
    let store = asset.store();
    let (mut out, mut offset) = ([0.0; 512], 0);
    for (i, codec) in store.codecs().iter().enumerate() {
        assert!(i % 1000 != 0 || store.offset(i) == offset);
        assert!(store.is_brick(*codec, offset));
        if store.decode(*codec, offset, 1.0, 0.0, &mut out).is_ok() {
            assert!(out.iter().all(|value| *value >= 0.0));
        }
        offset += codec.word_count() as u32;
    }
    for frame in 0..asset.contents().frames.len().min(4) {
        assert!(!loaded || asset.load_frame(frame).is_ok());
    }
});
