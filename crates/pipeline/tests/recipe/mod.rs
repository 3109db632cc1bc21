//! Trees of every kind from a few numbers.

use std::collections::BTreeSet;

use nuage_vdb::{Shape, Tree, TreeBuilder};
use proptest::prelude::*;

/// Random numbers from a seed.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    pub(crate) fn below(&mut self, end: u64) -> u64 {
        self.next() % end
    }

    /// Between 0 and 1.
    pub(crate) fn part(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1 << 24) as f32
    }
}

/// What a random tree is to be like.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Recipe {
    pub(crate) seed: u64,
    pub(crate) leaves: usize,
    pub(crate) tiles: [usize; 3],
    pub(crate) background: f32,
    pub(crate) low: f32,
    pub(crate) high: f32,
    pub(crate) middle: [i32; 3],
}

pub(crate) const MIDDLES: [[i32; 3]; 6] = [
    [0; 3],
    [-4096, 4096, 0],
    [1 << 30, -(1 << 30), 98_760],
    [i32::MIN, i32::MIN, i32::MIN],
    [i32::MAX - 63, 0, i32::MIN],
    [-128, 128, -4096],
];

pub(crate) fn recipes() -> impl Strategy<Value = Recipe> {
    let background = prop::sample::select(vec![0.0_f32, 0.0, 0.3, -0.3, 1.0]);
    let low = prop::sample::select(vec![0.0_f32, 0.0, -1.0, 0.2]);
    let scale = prop::sample::select(vec![1.0_f32, 1e-6, 300.0, 1e9]);
    let middle = prop::sample::select(MIDDLES.to_vec());
    (any::<u64>(), 0_usize..14, (0_usize..3, 0_usize..4, 0_usize..6), background, low, scale, middle)
        .prop_map(|(seed, leaves, (a, b, c), background, low, scale, middle)| Recipe {
            seed,
            leaves,
            tiles: [a, b, c],
            background: background * scale,
            low: low * scale,
            high: scale,
            middle,
        })
}

pub(crate) fn tree_of(recipe: &Recipe) -> Tree<f32> {
    let Recipe { background, low, high, .. } = *recipe;
    let mut random = Random(recipe.seed);
    let mut builder = TreeBuilder::new(background, Shape::STANDARD);
    // What is taken at each depth, and what holds something finer.
    let mut taken: [BTreeSet<[i32; 3]>; 3] = Default::default();
    let at = |origin: [i32; 3], log2: u32| origin.map(|c| c & (-1 << log2));
    let place = |random: &mut Random, spread: u64| -> [i32; 3] {
        let mut near = |c: i32| {
            let step = random.below(2 * spread) as i32 - spread as i32;
            c.saturating_add(step)
        };
        recipe.middle.map(&mut near)
    };
    let mut keep = |origin: [i32; 3], depth: usize| {
        let [root, node4, leaf] = [at(origin, 12), at(origin, 7), at(origin, 3)];
        let is_free = match depth {
            2 => taken[2].insert(leaf),
            1 => !taken[1].contains(&node4),
            _ => !taken[0].contains(&root),
        };
        if is_free {
            taken[1].insert(node4);
            taken[0].insert(root);
        }
        is_free
    };
    for _ in 0..recipe.leaves {
        let origin = at(place(&mut random, 24), 3);
        if keep(origin, 2) {
            let kind = random.below(5);
            let (base, slope) = (random.part(), [0; 3].map(|_| (random.part() - 0.5) / 8.0));
            let values: Vec<f32> = (0..512)
                .map(|i| {
                    let wave = base
                        + [i >> 6, i >> 3 & 7, i & 7]
                            .iter()
                            .zip(slope)
                            .map(|(i, s)| *i as f32 * s)
                            .sum::<f32>();
                    let noise = random.part();
                    let part = match kind {
                        0 => wave + 0.02 * noise,
                        1 => noise,
                        2 if noise > 0.1 => return background,
                        3 => base,
                        _ => wave,
                    };
                    low + (high - low) * part.clamp(0.0, 1.0)
                })
                .collect();
            builder.leaf(origin, &[random.next(); 8], &values);
        }
    }
    for (depth, spread) in [(2, 40), (1, 300), (0, 9000)] {
        for _ in 0..recipe.tiles[depth] {
            let origin = place(&mut random, spread);
            if keep(origin, depth) {
                let value = low + (high - low) * random.part();
                builder.tile(depth, origin, value, random.below(2) == 0);
            }
        }
    }
    builder.build().unwrap()
}
