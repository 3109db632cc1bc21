//! Transforms as they are written: the type's name and its numbers.
//!
//! A map is written as the type that it names if its matrix is of that type, else as an affine one.

use super::append_text;
use crate::error::Result;
use crate::transform::{Map, Matrix4, Transform};

/// How far a unitary matrix times its transpose may be off the identity.
const UNITARY_TOLERANCE: f64 = 1e-6;

/// Appends a transform.
pub(super) fn append(transform: &Transform, bytes: &mut Vec<u8>) -> Result<()> {
    match &transform.map {
        Map::Linear(matrix) => append_linear(&transform.type_name, matrix, bytes),
        Map::Frustum { index_box, taper, depth, linear } => {
            append_text("NonlinearFrustumMap", bytes)?;
            append_numbers(index_box.as_flattened(), bytes);
            append_numbers(&[*taper, *depth], bytes);
            // OpenVDB makes an affine map of the inner one, whatever it was.
            append_linear("AffineMap", linear, bytes)
        }
    }
}

fn append_linear(type_name: &str, matrix: &Matrix4, bytes: &mut Vec<u8>) -> Result<()> {
    let scale = [matrix[0][0], matrix[1][1], matrix[2][2]];
    let [x, y, z, _] = matrix[3];
    let translation = [x, y, z];
    let has_scale = is_scale_and_translation(matrix);
    let is_uniform = scale[0] == scale[1] && scale[0] == scale[2];
    let fits = match type_name {
        "UniformScaleMap" => has_scale && is_uniform && translation == [0.0; 3],
        "ScaleMap" => has_scale && translation == [0.0; 3],
        "UniformScaleTranslateMap" => has_scale && is_uniform,
        "ScaleTranslateMap" => has_scale,
        "TranslationMap" => has_scale && scale == [1.0; 3],
        "UnitaryMap" => is_unitary(matrix),
        _ => false,
    };
    append_text(if fits { type_name } else { "AffineMap" }, bytes)?;
    if !fits || type_name == "UnitaryMap" {
        append_numbers(matrix.as_flattened(), bytes);
        return Ok(());
    }
    if type_name.contains("Transl") {
        append_numbers(&translation, bytes);
    }
    if type_name.contains("Scale") {
        append_numbers(&scale, bytes);
        // What follows from the scale: the size of a voxel, the inverse, that squared, and half of it.
        append_numbers(&scale.map(f64::abs), bytes);
        append_numbers(&scale.map(|s| 1.0 / s), bytes);
        append_numbers(&scale.map(|s| (1.0 / s) * (1.0 / s)), bytes);
        append_numbers(&scale.map(|s| 1.0 / s / 2.0), bytes);
    }
    Ok(())
}

/// Whether nothing but the diagonal and the translation differs from the identity. No scale may be zero,
/// since maps of that kind hold its inverse.
fn is_scale_and_translation(matrix: &Matrix4) -> bool {
    let off_diagonal = |row: usize, column: usize| row < 3 && column < 3 && row != column;
    let zeros =
        (0..4).all(|row| (0..4).all(|column| !off_diagonal(row, column) || matrix[row][column] == 0.0));
    zeros && is_affine(matrix) && (0..3).all(|i| matrix[i][i] != 0.0)
}

fn is_affine(matrix: &Matrix4) -> bool {
    matrix.map(|row| row[3]) == [0.0, 0.0, 0.0, 1.0]
}

fn is_unitary(matrix: &Matrix4) -> bool {
    let product = |a: usize, b: usize| (0..3).map(|i| matrix[a][i] * matrix[b][i]).sum::<f64>();
    let is_one = |a: usize, b: usize| (product(a, b) - f64::from(u8::from(a == b))).abs() < UNITARY_TOLERANCE;
    is_affine(matrix) && matrix[3][..3] == [0.0; 3] && (0..3).all(|a| (0..3).all(|b| is_one(a, b)))
}

fn append_numbers(numbers: &[f64], bytes: &mut Vec<u8>) {
    numbers.iter().for_each(|number| bytes.extend_from_slice(&number.to_le_bytes()));
}
