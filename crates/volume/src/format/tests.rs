//! Whole files, written and read again, whole and damaged.

use std::io::Cursor;

use glam::IVec3;
use proptest::prelude::*;

use super::page::tests::words;
use super::*;
use crate::brick::{BrickSummary, Bricks};
use crate::build::TreeBuilder;
use crate::codec::{Codec, DecodeError};
use crate::packed::build::{EntryScale, Packer};
use crate::packed::store::BrickStore;
use crate::packed::{Content, TreeRef, Trees};

fn compress(bytes: &[u8]) -> Vec<u8> {
    zstd::bulk::compress(bytes, 3).unwrap()
}

/// Bricks of every codec in two frames, the second of which has the second half of the bricks.
fn parts(brick_count: usize) -> (Contents, Trees, BrickStore) {
    let mut store = BrickStore::default();
    let flat = Codec::Gradient { bits: 0 };
    store.push_shape(Codec::F16, &[0x3c00; 256]).unwrap();
    let shape = store.push_shape(flat, &[1, 2, 3]).unwrap();
    let tags = (0..brick_count).map(|i| [1_u8, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 16, 17, 20, 24][i % 15]);
    let codecs: Vec<Codec> = tags.filter_map(Codec::from_tag).collect();
    let all = words(&codecs, 1, shape);
    let (mut rest, mut bricks) = (&all[..], Vec::new());
    for codec in &codecs {
        let words = rest.split_off(..codec.word_count()).unwrap();
        bricks.push((*codec, store.push(*codec, words).unwrap()));
    }
    let mut packer = Packer::default();
    let mut tree = |range: std::ops::Range<usize>| {
        let mut builder = TreeBuilder::new();
        let mut values = Vec::new();
        for i in range.clone() {
            let mut brick = [0.25; 512];
            brick[i % 512] = 1.0;
            values.extend(brick);
            let place = IVec3::new(i as i32 % 9 * 20, i as i32 / 9, -(i as i32 % 4) * 600);
            builder.brick(place, BrickSummary::of(&brick)).unwrap();
        }
        let order = builder.finish(Bricks::F32(values)).unwrap();
        let scale = EntryScale { unit: 1.0, background: 0.0 };
        packer.add(&order, &bricks[range], scale, |value| value).unwrap()
    };
    let levels = [tree(0..brick_count), tree(brick_count / 2..brick_count)];
    let frame = |number: i64, level: TreeRef| Frame {
        number: Some(number),
        name: format!("smoke.{number:04}.vdb"),
        grids: vec![FrameGrid {
            channel: 0,
            levels: vec![level],
            index_offset: [-5, 0, 3],
            active_box: Some([[-5, 0, 3], [90, 80, 70]]),
            world_from_index: Some([0.1, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.1, 1e-300, -7.0, 1.0 / 3.0]),
            source_header: vec![number as u8; number as usize],
        }],
        source: Some(format!("{number:032x}")),
    };
    let contents = Contents {
        frame_rate: Some(24.0),
        channels: vec![ChannelInfo {
            name: "density".to_owned(),
            component: None,
            role: Role::Density,
            physical_unit: String::new(),
            unit: 2.0,
            floor: -1.5e-39,
            peak: f32::MAX / 3.0,
            quality: Quality { max_error: 0.1, squared_error: 1.0 / 3.0, voxels: u64::MAX },
            asked_max_error: Some(0.1),
            asked_psnr: None,
            encoding: Some(Encoding { lambda: 1e300 / 3.0, range: [-0.1, 2.0], source_bricks: u64::MAX }),
        }],
        frames: vec![frame(0, levels[0]), frame(7, levels[1])],
        asked: Some(Asked {
            all: AskedOfChannel { max_error: Some(0.1), psnr: Some(1.0 / 3.0), ..AskedOfChannel::default() },
            channels: vec![("flame".into(), AskedOfChannel { codec: Some(3), ..AskedOfChannel::default() })],
            ..Asked::default()
        }),
        recipe: Some("recipe".to_owned()),
    };
    (contents, packer.finish(), store)
}

fn file(brick_count: usize) -> Vec<u8> {
    let (contents, trees, store) = parts(brick_count);
    let mut out = Cursor::new(Vec::new());
    let summary = write(&mut out, &contents, &trees, &store, &compress).unwrap();
    assert_eq!(out.get_ref().len() as u64, summary.file_bytes);
    let chunks = summary.chunk_bytes.iter().map(|(_, bytes)| bytes).sum::<u64>();
    assert!(chunks < summary.file_bytes);
    out.into_inner()
}

/// Everything that a file says. `None` if it is damaged.
fn read_all(bytes: Vec<u8>) -> Option<(Contents, Trees, BrickStore)> {
    let limits = Limits { max_memory_bytes: 64 << 20 };
    let asset = Asset::open_with(bytes, limits).and_then(|mut asset| asset.load_all().map(|()| asset));
    match asset {
        Ok(asset) => Some((asset.contents().clone(), asset.trees().clone(), asset.store().clone())),
        Err(FormatError::Io(_) | FormatError::Misuse(_)) => panic!("not the file's fault"),
        Err(_) => None,
    }
}

#[test]
fn what_is_written_is_read() {
    for count in [0, 1, 33, 2000] {
        let bytes = file(count);
        assert_eq!(bytes, file(count), "the same bytes again");
        assert_eq!(read_all(bytes), Some(parts(count)), "{count} bricks");
    }
}

#[test]
fn pages_are_copied_as_they_are() {
    let asset = Asset::open(file(2000)).unwrap();
    assert!(asset.check_pages().is_ok());
    let mut out = Cursor::new(Vec::new());
    let mut writer = Writer::new(&mut out, &compress).unwrap();
    let mut rest = asset.store().shape_words();
    for codec in asset.store().shape_codecs() {
        let words = rest.split_off(..codec.word_count()).unwrap();
        writer.shape(*codec, words).unwrap();
    }
    for page in 0..asset.store().pages().len() {
        let (words, offset) = writer.copy_page(&asset, page).unwrap();
        assert_eq!((offset, words), (asset.store().pages()[page].first_word, asset.read_page(page).unwrap()));
    }
    // Bricks behind a copied page go to another, in the file that the first frames are in as well.
    let end = writer.brick(Codec::F16, &[0; 256]).unwrap();
    assert_eq!(end, asset.store().offset(2000));
    writer.copy_page(&asset, 0).unwrap();
    writer.finish(asset.contents(), asset.trees()).unwrap();
    let mut copied = Asset::open(out.into_inner()).unwrap();
    assert_eq!((copied.contents(), copied.trees()), (asset.contents(), asset.trees()));
    assert!(copied.store().codecs().starts_with(asset.store().codecs()));
    copied.load_all().unwrap();
    for page in 0..asset.store().pages().len() {
        assert_eq!(copied.store().pages()[page].words(), Some(&asset.read_page(page).unwrap()[..]));
    }
}

#[test]
fn pages_come_when_they_are_needed_and_go() {
    let (contents, trees, store) = parts(2000);
    let mut asset = Asset::open(file(2000)).unwrap();
    assert!(store.pages().len() > 3);
    let present = |asset: &Asset| asset.store().pages().iter().filter(|page| page.words().is_some()).count();
    let empty = asset.memory_bytes();
    assert_eq!(present(&asset), 0);
    let range = asset.store().pages()[1].bricks();
    asset.load_bricks(range.end - 1..range.end + 1).unwrap();
    assert_eq!(present(&asset), 2);
    asset.drop_page(1);
    asset.drop_page(2);
    assert_eq!(asset.memory_bytes(), empty);
    asset.load_frame(1).unwrap();
    let loaded = present(&asset);
    assert!(loaded < store.pages().len());
    let in_memory = Asset::from_parts(contents, trees, store).unwrap();
    let (mut found, mut expected) = ([0.0; 512], [0.0; 512]);
    for i in 1000..2000_i32 {
        let place = IVec3::new(i % 9 * 20, i / 9, -(i % 4) * 600);
        let tree = asset.contents().frames[1].grids[0].levels[0];
        let (Content::Brick { codec, offset }, 0) = asset.trees().find(tree, place) else {
            panic!("no brick")
        };
        asset.decode(0, codec, offset, &mut found).unwrap();
        in_memory.decode(0, codec, offset, &mut expected).unwrap();
        assert_eq!(found, expected);
    }
    assert!(matches!(asset.load_frame(2), Err(FormatError::Misuse(_))));
    asset.load_all().unwrap();
    assert_eq!(asset.memory_bytes().bricks - empty.bricks, 4 * asset.store().offset(2000) as usize);
}

#[test]
fn every_prefix_is_an_error() {
    let bytes = file(16);
    for len in 0..bytes.len() {
        assert!(read_all(bytes[..len].to_vec()).is_none(), "{len} of {} bytes", bytes.len());
    }
}

#[test]
fn every_byte_matters_and_every_chunk_is_checked() {
    let bytes = file(31);
    // Of the chunks some bytes will do: each is under one checksum.
    let chunks_end = u64::from_le_bytes(bytes[16..24].try_into().unwrap()) as usize;
    let frame = (0..layout::HEADER_BYTES).chain(chunks_end..bytes.len());
    for at in frame.chain((layout::HEADER_BYTES..chunks_end).step_by(11)) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 1 << (at % 8);
        assert!(read_all(damaged).is_none(), "byte {at} of {}", bytes.len());
    }
    let rows = layout::read_table(&bytes, &Limits::default()).unwrap();
    for kind in Kind::ALL {
        let row = rows.iter().find(|row| row.kind == Some(kind)).unwrap();
        let mut damaged = bytes.clone();
        damaged[row.offset as usize] ^= 1;
        let error = layout::read_chunk(&damaged, row).unwrap_err().to_string();
        assert!(error.contains("checksum"), "{error}");
    }
}

/// A file with other rows in its table of contents, whose checksums are right.
fn with_rows(bytes: &[u8], change: impl FnOnce(&mut Vec<[u8; layout::ROW_BYTES]>)) -> Vec<u8> {
    let table_at = u64::from_le_bytes(bytes[16..24].try_into().unwrap());
    let mut rows = bytes[table_at as usize..].as_chunks().0.to_vec();
    change(&mut rows);
    let table = rows.concat();
    let mut out = bytes[..table_at as usize].to_vec();
    out[..layout::HEADER_BYTES].copy_from_slice(&layout::header(table_at, &table));
    out.extend(table);
    out
}

#[test]
fn unknown_chunks_are_skipped_and_doubled_or_missing_ones_are_not() {
    let bytes = file(31);
    let unknown = with_rows(&bytes, |rows| {
        let mut row = *rows.last().unwrap();
        row[..4].copy_from_slice(b"WHAT");
        row[4] = 77;
        row[8..16].copy_from_slice(&(bytes.len() as u64 - 1).to_le_bytes());
        row[16..24].copy_from_slice(&1_u64.to_le_bytes());
        rows.push(row);
    });
    assert_eq!(read_all(unknown), Some(parts(31)));
    for i in 0..Kind::ALL.len() {
        assert!(read_all(with_rows(&bytes, |rows| _ = rows.remove(i))).is_none());
        assert!(read_all(with_rows(&bytes, |rows| rows.insert(i, rows[i]))).is_none());
    }
    let coded = with_rows(&bytes, |rows| rows[0][4] = 2);
    assert!(matches!(Asset::open(coded), Err(FormatError::Unsupported { .. })));
    let mut later = bytes;
    later[8] += 1;
    assert!(matches!(Asset::open(later), Err(FormatError::Unsupported { .. })));
}

#[test]
fn memory_is_limited_before_it_is_taken() {
    let bytes = file(300);
    let open = |max_memory_bytes| Asset::open_with(bytes.clone(), Limits { max_memory_bytes });
    assert!(matches!(open(3000), Err(FormatError::Limit { .. })));
    let mut asset = open(60_000).unwrap();
    assert!(matches!(asset.load_all(), Err(FormatError::Limit { .. })));
    // A size that no stream of these bytes has is an error before anything is decompressed.
    for decoded in [1_u64 << 33, u64::MAX] {
        let large = with_rows(&bytes, |rows| {
            rows.iter_mut().for_each(|row| row[24..32].copy_from_slice(&decoded.to_le_bytes()))
        });
        let limits = Limits { max_memory_bytes: u64::MAX };
        assert!(matches!(
            Asset::open_with(large, limits),
            Err(FormatError::Malformed { .. } | FormatError::Limit { .. })
        ));
    }
}

#[test]
fn what_does_not_fit_together_is_not_written() {
    let (contents, trees, store) = parts(20);
    let refused = |contents: &Contents, trees: &Trees| {
        let written = write(Cursor::new(Vec::new()), contents, trees, &store, &compress);
        let joined = Asset::from_parts(contents.clone(), trees.clone(), store.clone());
        matches!((written, joined), (Err(FormatError::Misuse(_)), Err(FormatError::Misuse(_))))
    };
    assert!(!refused(&contents, &trees));
    let changes: [fn(&mut Contents, &mut Trees); 8] = [
        |contents, _| contents.frame_rate = Some(f64::NAN),
        |contents, _| contents.channels[0].unit = 3.0,
        |contents, _| contents.channels[0].peak = f32::INFINITY,
        |contents, _| contents.frames[0].grids[0].channel = 1,
        |contents, _| contents.frames[1].grids[0].levels[0].cell_count += 1,
        |contents, _| contents.frames[1].grids[0].levels[0].first_cell = u32::MAX,
        |_, trees| trees.cells.swap(0, 1),
        |_, trees| trees.entries.iter_mut().for_each(|entry| entry.payload += 1),
    ];
    for (i, change) in changes.iter().enumerate() {
        let (mut contents, mut trees) = (contents.clone(), trees.clone());
        change(&mut contents, &mut trees);
        assert!(refused(&contents, &trees), "change {i}");
    }
    assert!(Writer::new(Cursor::new(Vec::new()), &compress).unwrap().brick(Codec::F16, &[0]).is_err());
}

#[test]
fn roles_of_later_versions_are_other() {
    let (contents, ..) = parts(1);
    let json = serde_json::to_string(&contents).unwrap();
    for (role, name) in [(Role::Density, "Density"), (Role::Colour, "Colour"), (Role::Other, "Plasma")] {
        let changed = json.replace("\"Density\"", &format!("{name:?}"));
        let contents: Contents = serde_json::from_str(&changed).unwrap();
        assert_eq!(contents.channels[0].role, role);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn damage_under_right_checksums_is_an_error_or_an_asset(
        changes in proptest::collection::vec((0_u16..2, any::<u32>(), any::<u8>()), 1..6),
    ) {
        let (contents, trees, store) = parts(31);
        let mut out = Cursor::new(Vec::new());
        // Nothing is compressed, so that damage reaches what is inside.
        write(&mut out, &contents, &trees, &store, &|bytes| vec![0; bytes.len() + 1]).unwrap();
        let mut bytes = out.into_inner();
        let pages_end = u64::from_le_bytes(bytes[bytes.len() - 10 * layout::ROW_BYTES + 8..][..8].try_into().unwrap());
        for (after_pages, at, byte) in changes {
            let from = pages_end as usize * usize::from(after_pages);
            let at = from + at as usize % (bytes.len() - from);
            bytes[at] = byte;
        }
        reseal(&mut bytes);
        let Ok(asset) = Asset::open_with(bytes.clone(), Limits { max_memory_bytes: 64 << 20 }) else { return Ok(()) };
        prop_assert!(check::check(asset.contents(), asset.trees(), asset.store()).is_ok());
        let Some((_, _, store)) = read_all(bytes) else { return Ok(()) };
        let mut values = [0.0; 512];
        for (i, codec) in store.codecs().iter().enumerate() {
            let decoded = store.decode(*codec, store.offset(i), 1.0, 0.0, &mut values);
            prop_assert!(decoded != Err(DecodeError::NoShape) && decoded != Err(DecodeError::OutOfStore));
        }
    }

    #[test]
    fn any_bytes_in_chunks_are_an_error_or_an_asset(
        chunk in 0_usize..11, bytes in proptest::collection::vec(any::<u8>(), 0..200), compressed in any::<bool>(), keep in 0_usize..100,
    ) {
        let valid = file(31);
        let rows = layout::read_table(&valid, &Limits::default()).unwrap();
        let row = rows[chunk];
        // The first bytes as they were, then anything.
        let mut decoded = layout::read_chunk(&valid, &row).unwrap();
        decoded.truncate(keep);
        decoded.extend(&bytes);
        let stored = if compressed { compress(&decoded) } else { decoded.clone() };
        let table_at = u64::from_le_bytes(valid[16..24].try_into().unwrap());
        let mut out = valid[..table_at as usize].to_vec();
        let mut rows: Vec<layout::Row> = rows;
        let mut moved = rows.remove(chunk);
        moved.is_compressed = compressed;
        (moved.offset, moved.stored_bytes) = (table_at, stored.len() as u64);
        (moved.decoded_bytes, moved.checksum) = (decoded.len() as u64, xxhash_rust::xxh3::xxh3_64(&stored));
        rows.push(moved);
        out.extend(stored);
        let table: Vec<u8> = rows.iter().flat_map(|row| row.to_bytes()).collect();
        let header = layout::header(out.len() as u64, &table);
        out[..layout::HEADER_BYTES].copy_from_slice(&header);
        out.extend(table);
        if let Some((contents, trees, store)) = read_all(out) {
            prop_assert!(check::check(&contents, &trees, &store).is_ok());
        }
    }
}

#[test]
fn a_compressor_that_gives_nothing_costs_nothing_but_bytes() {
    let (contents, trees, store) = parts(40);
    let mut file = Cursor::new(Vec::new());
    write(&mut file, &contents, &trees, &store, &|_| Vec::new()).unwrap();
    let mut asset = Asset::open(file.into_inner()).unwrap();
    asset.load_all().unwrap();
    assert_eq!((asset.contents(), asset.trees()), (&contents, &trees));
    assert_eq!(asset.store(), &store);
}
