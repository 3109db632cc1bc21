//! What can be said of the written files without a reader of trees.

use std::collections::HashSet;

use super::*;

/// Reads numbers and texts from the start of a file.
struct Walk<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Walk<'a> {
    fn take(&mut self, count: usize) -> &'a [u8] {
        self.at += count;
        &self.bytes[self.at - count..self.at]
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take(4).try_into().unwrap())
    }

    fn position(&mut self) -> usize {
        u64::from_le_bytes(self.take(8).try_into().unwrap()) as usize
    }

    fn text(&mut self) -> &'a str {
        let count = self.u32() as usize;
        std::str::from_utf8(self.take(count)).unwrap()
    }

    fn metadata(&mut self) -> Vec<&'a str> {
        let count = self.u32();
        let mut names = Vec::new();
        for _ in 0..count {
            names.push(self.text());
            self.text();
            let size_bytes = self.u32() as usize;
            self.take(size_bytes);
        }
        names
    }
}

#[test]
fn headers_descriptors_and_positions_stand_where_their_version_has_them() {
    for (name, file) in corpus() {
        let bytes = file.bytes();
        let mut walk = Walk { bytes: &bytes, at: 0 };
        assert_eq!(walk.take(8), b" BDV\0\0\0\0", "{name}");
        assert_eq!([walk.u32(), walk.u32(), walk.u32()], [file.version, file.library[0], file.library[1]]);
        assert_eq!(walk.take(1), [u8::from(file.has_offsets)], "{name}");
        if [220, 221].contains(&file.version) {
            assert_eq!(u32::from(walk.take(1)[0]), file.compression & ZIP, "{name}");
        }
        if file.version >= 218 {
            let uuid = walk.take(36);
            let dashes: Vec<_> = (0..36).filter(|i| uuid[*i] == b'-').collect();
            assert_eq!(dashes, [8, 13, 18, 23], "{name}");
            assert!(uuid.iter().all(|byte| byte.is_ascii_hexdigit() || *byte == b'-'), "{name}");
        } else {
            walk.take(16);
        }
        assert_eq!(walk.metadata(), ["creator"], "{name}");
        assert_eq!(walk.u32() as usize, file.grids.len(), "{name}");
        for grid in &file.grids {
            assert_eq!(walk.text(), grid.name, "{name}");
            assert_eq!(walk.text().trim_end_matches("_HalfFloat"), grid.type_name(), "{name}");
            if file.version >= 216 {
                assert_eq!(walk.text(), grid.instance_of.as_deref().unwrap_or_default(), "{name}");
            }
            let [begin, blocks, end] = [(); 3].map(|()| walk.position());
            if !file.has_offsets {
                assert_eq!([begin, blocks, end], [0; 3], "{name}");
                break;
            }
            assert_eq!(begin, walk.at, "{name}");
            if file.version >= 222 {
                assert_eq!(walk.u32(), file.compression, "{name}");
            }
            assert_eq!(walk.metadata().contains(&"name"), file.version >= 219, "{name}");
            let maps = [
                "LinearTransform",
                "FrustumTransform",
                "ScaleTranslateMap",
                "AffineMap",
                "NonlinearFrustumMap",
            ];
            if file.version >= 216 {
                let map = walk.text();
                let known = maps.iter().position(|known| map == *known);
                assert!(known.is_some_and(|i| (i < 2) == (file.version < 219)), "{map} in {name}");
            } else {
                assert_eq!(walk.u32(), 1, "one buffer per leaf, then the root: {name}");
            }
            match &grid.instance_of {
                Some(_) => assert_eq!(blocks, 0, "{name}"),
                None => assert!(begin < blocks && blocks < end, "{name}"),
            }
            walk.at = end;
        }
        assert!(!file.has_offsets || walk.at == bytes.len(), "{name} goes on behind its last grid");
    }
}

#[test]
fn the_same_description_gives_the_same_bytes_and_each_file_is_unlike_the_others() {
    let mut known = HashSet::new();
    for ((name, file), (again, same)) in corpus().into_iter().zip(corpus()) {
        assert_eq!((&name, file.bytes()), (&again, same.bytes()));
        assert!(known.insert(file.bytes()), "{name} is in the corpus twice");
    }
}

#[test]
fn a_description_finds_its_own_leaves_and_tiles() {
    for (name, file) in corpus() {
        for grid in &file.grids {
            for tile in &grid.tiles {
                let last = (1 << grid.log2_tile(tile.depth)) - 1;
                let found =
                    Found { value: grid.rounded(&tile.value), active: tile.active, depth: tile.depth as i32 };
                assert_eq!(grid.at(tile.origin), found, "{name}");
                assert_eq!(grid.at(tile.origin.map(|c| c + last)), found, "{name}");
            }
            for leaf in &grid.leaves {
                let size = 1 << grid.log2_tile(grid.leaf_depth() - 1);
                // x is the slowest, z the fastest.
                for (local, slot) in [([0, 0, 1], 1), ([0, 1, 0], size), ([1, 0, 0], size * size)] {
                    let found = grid.at(std::array::from_fn(|i| leaf.origin[i] + local[i]));
                    assert_eq!(
                        (found.depth, found.active),
                        (grid.leaf_depth() as i32, leaf.mask[slot]),
                        "{name}"
                    );
                    if grid.value_type != "mask" {
                        assert_eq!(found.value, grid.rounded(&leaf.values[slot]), "{name}");
                    }
                }
            }
            assert_eq!(grid.at([i32::MIN; 3]).depth, -1, "{name}");
        }
    }
}

#[test]
fn a_frustum_is_as_wide_and_deep_as_it_says() {
    let identity = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    let transform = SyntheticTransform::Frustum {
        index_box: [[0; 3], [10, 20, 40]],
        taper: 0.5,
        depth: 3.0,
        near_width: 2.0,
        near_distance: 7.0,
        camera: identity,
    };
    assert_eq!(transform.world_from_index([0.0; 3]), [-1.0, -2.0, -7.0]);
    assert_eq!(transform.world_from_index([10.0, 20.0, 0.0]), [1.0, 2.0, -7.0]);
    assert_eq!(transform.world_from_index([10.0, 10.0, 40.0]), [2.0, 0.0, -13.0]);
}
