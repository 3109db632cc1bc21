//! Whether contents, trees and bricks fit together.

use super::contents::Contents;
use crate::packed::Trees;
use crate::packed::store::BrickStore;

/// Checks all of an asset but the words of its bricks.
///
/// # Errors
/// The first thing that is wrong, in words.
pub(super) fn check(contents: &Contents, trees: &Trees, store: &BrickStore) -> Result<(), String> {
    if let Some(fault) = contents.fault() {
        return Err(fault);
    }
    trees.check(|codec, offset| store.is_brick(codec, offset)).map_err(|error| error.to_string())?;
    // How many cells up to each one are not in order after the one before.
    let mut unordered = 0_u32;
    let unordered_up_to: Vec<u32> = (0..trees.cells.len())
        .map(|i| {
            unordered += u32::from(i > 0 && trees.cells[i - 1].cell >= trees.cells[i].cell);
            unordered
        })
        .collect();
    for tree in contents.grids().flat_map(|grid| &grid.levels) {
        let first = tree.first_cell as usize;
        let last = match tree.cell_count {
            0 => continue,
            count => first + (count as usize - 1),
        };
        match (unordered_up_to.get(first), unordered_up_to.get(last)) {
            (Some(first), Some(last)) if first == last => {}
            (Some(_), Some(_)) => return Err("a tree whose root cells are not in order".to_owned()),
            _ => return Err("a tree with root cells that are not there".to_owned()),
        }
    }
    Ok(())
}
