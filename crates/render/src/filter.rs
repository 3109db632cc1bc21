//! Filters: what the values of voxels say of the points between them.

/// How a value is made of the voxels around a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Filter {
    /// The voxel at `floor(p + ½)`.
    Nearest,
    /// Linear along each axis between the eight voxels from `floor(p)` on.
    Trilinear,
}
