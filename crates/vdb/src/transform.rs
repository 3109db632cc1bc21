//! Index-to-world transforms: the map types that a VDB file can hold.
//!
//! A map is read and kept as it is written; what callers need is [`Transform::world_from_index`] and, for the
//! linear ones, [`Transform::matrix`]. Matrices are stored as OpenVDB stores them: rows of a row-vector
//! convention, so that `world = [index, 1] * matrix` and the translation is the last row.

mod legacy;

use crate::error::{Error, Result};
use crate::source::Reader;
use crate::stats::IndexBox;

/// From this version on the box of a frustum is in floating point.
const FLOAT_BOX_SINCE: u32 = 221;

/// A 4×4 matrix in row-vector convention: `m[row][column]`, translation in `m[3]`.
pub type Matrix4 = [[f64; 4]; 4];

/// The transform of a grid: its map's type name as in the file, and what it does.
#[derive(Debug, Clone, PartialEq)]
pub struct Transform {
    /// `UniformScaleMap`, `AffineMap`, …
    pub type_name: String,
    /// The map itself.
    pub map: Map,
}

/// What a map does to an index coordinate.
#[derive(Debug, Clone, PartialEq)]
pub enum Map {
    /// Any of the linear maps: scale, translation, both, unitary or affine.
    Linear(Matrix4),
    /// `NonlinearFrustumMap`: a box of index space seen through a camera.
    Frustum {
        /// The box in index space, `[min, max]`.
        index_box: [[f64; 3]; 2],
        /// Width of the near face over the width of the far face.
        taper: f64,
        /// Depth of the frustum over the width of its near face.
        depth: f64,
        /// What follows the frustum.
        linear: Matrix4,
    },
}

impl Transform {
    /// The matrix of a linear transform; `None` for a frustum.
    pub fn matrix(&self) -> Option<&Matrix4> {
        match &self.map {
            Map::Linear(matrix) => Some(matrix),
            Map::Frustum { .. } => None,
        }
    }

    /// The world position of an index coordinate.
    pub fn world_from_index(&self, index: [f64; 3]) -> [f64; 3] {
        match &self.map {
            Map::Linear(matrix) => apply(matrix, index),
            Map::Frustum { index_box: [min, max], taper, depth, linear } => {
                let size = [max[0] - min[0], max[1] - min[1], max[2] - min[2]];
                let centred = [
                    index[0] - 0.5 * (min[0] + max[0]),
                    index[1] - 0.5 * (min[1] + max[1]),
                    index[2] - min[2],
                ];
                let z = centred[2] * depth / size[2];
                let widening = (1.0 / taper - 1.0) / depth;
                let scale = (widening * z + 1.0) / size[0];
                apply(linear, [centred[0] * scale, centred[1] * scale, z])
            }
        }
    }

    /// The index coordinate of a world position. `None` if the map has no inverse, or is not finite there.
    pub fn index_from_world(&self, world: [f64; 3]) -> Option<[f64; 3]> {
        let found = match &self.map {
            Map::Linear(matrix) => unapply(matrix, world),
            Map::Frustum { index_box: [min, max], taper, depth, linear } => {
                let size = [max[0] - min[0], max[1] - min[1], max[2] - min[2]];
                let [x, y, z] = unapply(linear, world);
                let widening = (1.0 / taper - 1.0) / depth;
                let scale = (widening * z + 1.0) / size[0];
                let middle = [0.5 * (min[0] + max[0]), 0.5 * (min[1] + max[1])];
                [x / scale + middle[0], y / scale + middle[1], z * size[2] / depth + min[2]]
            }
        };
        found.iter().all(|x| x.is_finite()).then_some(found)
    }

    /// The index box that holds all voxels whose centres lie in a box of world space, given by any two opposite
    /// corners. `None` if there is no such voxel, or the map has no inverse.
    pub fn index_box_from_world(&self, corners: [[f64; 3]; 2]) -> Option<IndexBox> {
        let [mut min, mut max] = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
        for corner in 0..8_usize {
            let world = std::array::from_fn(|axis| corners[corner >> axis & 1][axis]);
            let index = self.index_from_world(world)?;
            min = std::array::from_fn(|axis| min[axis].min(index[axis]));
            max = std::array::from_fn(|axis| max[axis].max(index[axis]));
        }
        // What stands on the border is inside, in spite of rounding.
        let bbox = [min.map(|x| (x - 1e-6).ceil() as i32), max.map(|x| (x + 1e-6).floor() as i32)];
        (0..3).all(|axis| bbox[0][axis] <= bbox[1][axis]).then_some(bbox)
    }

    /// The size of a voxel in world units, per axis: the lengths of the images of the unit vectors, for a
    /// frustum at the middle of its near face.
    pub fn voxel_size(&self) -> [f64; 3] {
        let at = match &self.map {
            Map::Linear(_) => [0.0; 3],
            Map::Frustum { index_box: [min, max], .. } => {
                [0.5 * (min[0] + max[0]), 0.5 * (min[1] + max[1]), min[2]]
            }
        };
        let origin = self.world_from_index(at);
        std::array::from_fn(|axis| {
            let mut next = at;
            next[axis] += 1.0;
            let world = self.world_from_index(next);
            (0..3).map(|i| (world[i] - origin[i]).powi(2)).sum::<f64>().sqrt()
        })
    }

    /// World space as index space.
    pub fn identity() -> Self {
        Transform::uniform_scale(1.0)
    }

    /// Voxels of one size along all axes, the voxel at the origin centred on the origin of the world.
    pub fn uniform_scale(voxel_size: f64) -> Self {
        let matrix = diagonal([voxel_size; 3], [0.0; 3]);
        Transform { type_name: "UniformScaleMap".into(), map: Map::Linear(matrix) }
    }

    /// Any affine transform: `world = [index, 1] * matrix`.
    pub fn affine(matrix: Matrix4) -> Self {
        Transform { type_name: "AffineMap".into(), map: Map::Linear(matrix) }
    }

    /// Reads a map's type name and the map.
    pub(crate) fn read(reader: &mut Reader<'_>, file_version: u32) -> Result<Self> {
        let type_name = reader.string("a transform's type name")?;
        if file_version < legacy::MAPS_SINCE {
            return legacy::read(&type_name, reader);
        }
        let map = match type_name.as_str() {
            "NonlinearFrustumMap" => {
                let index_box = match file_version {
                    FLOAT_BOX_SINCE.. => [reader.vec3d("a frustum's box")?, reader.vec3d("a frustum's box")?],
                    _ => {
                        let mut corner =
                            || -> Result<[f64; 3]> { Ok(reader.coord("a frustum's box")?.map(f64::from)) };
                        [corner()?, corner()?]
                    }
                };
                let taper = reader.f64("a frustum's taper")?;
                let depth = reader.f64("a frustum's depth")?;
                let inner = reader.string("a frustum's linear map")?;
                Map::Frustum { index_box, taper, depth, linear: read_linear(&inner, reader)? }
            }
            _ => Map::Linear(read_linear(&type_name, reader)?),
        };
        Ok(Transform { type_name, map })
    }
}

/// The matrix of a scale followed by a translation.
fn diagonal(scale: [f64; 3], translation: [f64; 3]) -> Matrix4 {
    let [x, y, z] = scale;
    let [tx, ty, tz] = translation;
    [[x, 0.0, 0.0, 0.0], [0.0, y, 0.0, 0.0], [0.0, 0.0, z, 0.0], [tx, ty, tz, 1.0]]
}

fn apply(m: &Matrix4, [x, y, z]: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| x * m[0][i] + y * m[1][i] + z * m[2][i] + m[3][i])
}

/// What [`apply`] sends to a position, by Cramer's rule; not finite if there is no such thing.
fn unapply(m: &Matrix4, p: [f64; 3]) -> [f64; 3] {
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let [x, y, z] = [m[0], m[1], m[2]].map(|row| [row[0], row[1], row[2]]);
    let offset = std::array::from_fn(|i| p[i] - m[3][i]);
    let volume = dot(x, cross(y, z));
    [cross(y, z), cross(z, x), cross(x, y)].map(|across| dot(offset, across) / volume)
}

fn read_linear(type_name: &str, reader: &mut Reader<'_>) -> Result<Matrix4> {
    // Besides the scale, OpenVDB writes four vectors that follow from it: voxel size, inverse, squared and
    // halved inverse.
    let scale = |reader: &mut Reader<'_>| -> Result<[f64; 3]> {
        let scale = reader.vec3d("a scale")?;
        reader.take(4 * 24, "a scale map")?;
        Ok(scale)
    };
    match type_name {
        "ScaleMap" | "UniformScaleMap" => Ok(diagonal(scale(reader)?, [0.0; 3])),
        "TranslationMap" => Ok(diagonal([1.0; 3], reader.vec3d("a translation")?)),
        "ScaleTranslateMap" | "UniformScaleTranslateMap" => {
            let translation = reader.vec3d("a translation")?;
            Ok(diagonal(scale(reader)?, translation))
        }
        "AffineMap" | "UnitaryMap" => {
            let mut matrix = [[0.0; 4]; 4];
            for value in matrix.iter_mut().flatten() {
                *value = reader.f64("a matrix")?;
            }
            Ok(matrix)
        }
        _ => Err(Error::unsupported(format!("the transform type '{type_name}'"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_world_box_holds_the_voxels_whose_centres_it_holds() {
        let transform = Transform::uniform_scale(0.1);
        let corners = [[0.1, 0.45, -1.0], [0.3, -0.45, -0.71]];
        assert_eq!(transform.index_box_from_world(corners), Some([[1, -4, -10], [3, 4, -8]]));
        assert_eq!(transform.index_box_from_world([[0.11; 3], [0.19; 3]]), None);
    }

    #[test]
    fn index_from_world_undoes_world_from_index() {
        let linear =
            [[0.5, 0.1, 0.0, 0.0], [-0.2, 2.0, 0.3, 0.0], [0.0, 0.1, -1.5, 0.0], [3.0, -4.0, 5.0, 1.0]];
        let index_box = [[-10.0, -20.0, 5.0], [30.0, 40.0, 60.0]];
        let frustum = Map::Frustum { index_box, taper: 0.4, depth: 1.7, linear };
        for map in [Map::Linear(linear), frustum] {
            let transform = Transform { type_name: String::new(), map };
            for index in [[0.0; 3], [1.0, 2.0, 30.0], [-7.5, 12.25, 44.0]] {
                let back = transform.index_from_world(transform.world_from_index(index)).unwrap();
                assert!((0..3).all(|i| (back[i] - index[i]).abs() < 1e-9), "{index:?} {back:?}");
            }
        }
        let mut flat = linear;
        flat[1] = [0.0; 4];
        assert_eq!(Transform::affine(flat).index_from_world([1.0; 3]), None);
    }
}
