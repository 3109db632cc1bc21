//! Address arithmetic of the tree: which brick and which slot hold an index coordinate.
//!
//! Two integer spaces meet here. *Index* coordinates count voxels; *brick* coordinates count bricks of 8³
//! voxels and are index coordinates shifted right by three. A `Node4` spans 16³ bricks (128³ voxels), a
//! `Node5` 512³ bricks (4096³ voxels).

use glam::IVec3;

/// log2 of the voxels per axis of a brick.
pub const LOG2_BRICK: u32 = 3;
/// log2 of the bricks per axis of a `Node4`.
pub const LOG2_NODE4_BRICKS: u32 = 4;
/// log2 of the bricks per axis of a `Node5`.
pub const LOG2_NODE5_BRICKS: u32 = 9;
/// Voxels of a brick.
pub const BRICK_VOXELS: usize = 512;
/// Slots of a `Node4`.
pub const NODE4_SLOTS: usize = 4096;
/// Slots of a `Node5`.
pub const NODE5_SLOTS: usize = 32768;

/// The brick that holds a voxel.
pub fn brick_of(index: IVec3) -> IVec3 {
    index >> LOG2_BRICK
}

/// The offset of a voxel in its brick: `x << 6 | y << 3 | z`.
pub fn voxel_offset(index: IVec3) -> usize {
    let local = index & 7;
    (local.x << 6 | local.y << 3 | local.z) as usize
}

/// The slot of a brick in its `Node4`: `x << 8 | y << 4 | z` of the low four bits.
pub fn node4_slot(brick: IVec3) -> usize {
    let local = brick & 15;
    (local.x << 8 | local.y << 4 | local.z) as usize
}

/// The slot, in its `Node5`, of the `Node4` that holds a brick: `x << 10 | y << 5 | z`.
pub fn node5_slot(brick: IVec3) -> usize {
    let local = (brick >> LOG2_NODE4_BRICKS) & 31;
    (local.x << 10 | local.y << 5 | local.z) as usize
}

/// The cell of the root table that holds a brick.
pub fn root_cell(brick: IVec3) -> IVec3 {
    brick >> LOG2_NODE5_BRICKS
}

/// The first brick in a slot of the `Node4` whose first brick is `node`.
pub fn node4_slot_brick(node: IVec3, slot: usize) -> IVec3 {
    let slot = slot as i32;
    node + IVec3::new(slot >> 8 & 15, slot >> 4 & 15, slot & 15)
}

/// The first brick in a slot of the `Node5` whose first brick is `node`.
pub fn node5_slot_brick(node: IVec3, slot: usize) -> IVec3 {
    let slot = slot as i32;
    node + (IVec3::new(slot >> 10 & 31, slot >> 5 & 31, slot & 31) << LOG2_NODE4_BRICKS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn slots_and_bricks_are_inverse(x in any::<i32>(), y in any::<i32>(), z in any::<i32>()) {
            let brick = brick_of(IVec3::new(x, y, z));
            let node4 = brick & !15;
            prop_assert_eq!(node4_slot_brick(node4, node4_slot(brick)), brick);
            let node5 = root_cell(brick) << LOG2_NODE5_BRICKS;
            prop_assert_eq!(node5_slot_brick(node5, node5_slot(brick)), node4);
        }
    }
}
