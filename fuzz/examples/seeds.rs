//! Writes the inputs that fuzzing starts from: the small files of the test data, and synthetic ones of every version.
//!
//! `seeds CORPUS_FOLDER`

use std::path::Path;

use nuage_testkit::synthetic;

/// Larger files slow the fuzzer down more than they teach it.
const MAX_SEED_BYTES: usize = 48 << 10;
const TARGETS: [&str; 4] = ["read", "read_box", "round_trip", "metadata"];

fn main() -> std::io::Result<()> {
    let folder = std::env::args().nth(1).unwrap_or_else(|| "corpus".into());
    let mut seeds: Vec<(String, Vec<u8>)> =
        synthetic::corpus().into_iter().map(|(name, file)| (name, file.bytes())).collect();
    for data in ["data/edge", "data/edge/bad"] {
        for entry in std::fs::read_dir(nuage_testkit::committed(data))? {
            let path = entry?.path();
            if path.extension().is_some_and(|extension| extension == "vdb") {
                let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                seeds.push((name, std::fs::read(&path)?));
            }
        }
    }
    for target in TARGETS {
        let folder = Path::new(&folder).join(target);
        std::fs::create_dir_all(&folder)?;
        for (name, bytes) in seeds.iter().filter(|(_, bytes)| bytes.len() <= MAX_SEED_BYTES) {
            std::fs::write(folder.join(name), bytes)?;
        }
    }
    let packed = Path::new(&folder).join("nuage");
    std::fs::create_dir_all(&packed)?;
    std::fs::write(packed.join("all_codecs"), nuage_fuzz::packed_file())?;
    let nano = Path::new(&folder).join("nanovdb");
    std::fs::create_dir_all(&nano)?;
    for (name, bytes) in seeds.iter().filter(|(_, bytes)| bytes.len() <= MAX_SEED_BYTES) {
        for (i, encoded) in nuage_fuzz::as_nanovdb(bytes).into_iter().enumerate() {
            if encoded.len() <= 8 * MAX_SEED_BYTES {
                std::fs::write(nano.join(format!("{name}_{i}")), encoded)?;
            }
        }
    }
    Ok(())
}
