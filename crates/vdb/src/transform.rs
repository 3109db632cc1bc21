//! Index-to-world transforms: the map types that a VDB file can hold.
//!
//! A map is read and kept as it is written; what callers need is [`Transform::world_from_index`] and, for the
//! linear ones, [`Transform::matrix`]. Matrices are stored as OpenVDB stores them: rows of a row-vector
//! convention, so that `world = [index, 1] * matrix` and the translation is the last row.

use crate::error::{Error, Result};
use crate::source::Cursor;

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

    /// Reads a map's type name and the map.
    pub(crate) fn read(cursor: &mut Cursor<'_>) -> Result<Self> {
        let type_name = cursor.string("a transform's type name")?;
        let map = match type_name.as_str() {
            "NonlinearFrustumMap" => {
                let index_box = [cursor.vec3d("a frustum's box")?, cursor.vec3d("a frustum's box")?];
                let taper = cursor.f64("a frustum's taper")?;
                let depth = cursor.f64("a frustum's depth")?;
                let inner = cursor.string("a frustum's linear map")?;
                Map::Frustum { index_box, taper, depth, linear: read_linear(&inner, cursor)? }
            }
            _ => Map::Linear(read_linear(&type_name, cursor)?),
        };
        Ok(Transform { type_name, map })
    }
}

fn apply(m: &Matrix4, [x, y, z]: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| x * m[0][i] + y * m[1][i] + z * m[2][i] + m[3][i])
}

fn read_linear(type_name: &str, cursor: &mut Cursor<'_>) -> Result<Matrix4> {
    let diagonal = |scale: [f64; 3], translation: [f64; 3]| {
        let [x, y, z] = scale;
        let [tx, ty, tz] = translation;
        [[x, 0.0, 0.0, 0.0], [0.0, y, 0.0, 0.0], [0.0, 0.0, z, 0.0], [tx, ty, tz, 1.0]]
    };
    // Besides the scale, OpenVDB writes four vectors that follow from it: voxel size, inverse, squared and
    // halved inverse.
    let scale = |cursor: &mut Cursor<'_>| -> Result<[f64; 3]> {
        let scale = cursor.vec3d("a scale")?;
        cursor.take(4 * 24, "a scale map")?;
        Ok(scale)
    };
    match type_name {
        "ScaleMap" | "UniformScaleMap" => Ok(diagonal(scale(cursor)?, [0.0; 3])),
        "TranslationMap" => Ok(diagonal([1.0; 3], cursor.vec3d("a translation")?)),
        "ScaleTranslateMap" | "UniformScaleTranslateMap" => {
            let translation = cursor.vec3d("a translation")?;
            Ok(diagonal(scale(cursor)?, translation))
        }
        "AffineMap" | "UnitaryMap" => {
            let mut matrix = [[0.0; 4]; 4];
            for value in matrix.iter_mut().flatten() {
                *value = cursor.f64("a matrix")?;
            }
            Ok(matrix)
        }
        _ => Err(Error::unsupported(format!("the transform type '{type_name}'"))),
    }
}
