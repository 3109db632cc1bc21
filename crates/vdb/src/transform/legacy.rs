//! The transforms of files before version 219: chains of matrices instead of maps.
//!
//! Both kinds become maps of today's: an affine one, or a frustum.

use super::{Map, Matrix4, Transform, apply};
use crate::error::{Error, Result};
use crate::source::Reader;

/// From this version on transforms are maps.
pub(super) const MAPS_SINCE: u32 = 219;

/// Reads a transform of the given type from behind its name.
pub(super) fn read(type_name: &str, reader: &mut Reader<'_>) -> Result<Transform> {
    match type_name {
        "LinearTransform" => linear(reader),
        "FrustumTransform" => frustum(reader),
        _ => Err(Error::unsupported(format!("the transform type '{type_name}'"))),
    }
}

/// A box that nothing hangs on, then four matrices: local to world, its inverse, voxel to local, its inverse.
fn linear(reader: &mut Reader<'_>) -> Result<Transform> {
    skip_box(reader)?;
    let world_from_local = matrix(reader)?;
    matrix(reader)?;
    let local_from_voxel = matrix(reader)?;
    matrix(reader)?;
    Ok(Transform::affine(product(&local_from_voxel, &world_from_local)))
}

/// A camera by its matrices; the frustum is found by sending the corners of the unit cube through them.
fn frustum(reader: &mut Reader<'_>) -> Result<Transform> {
    let mut corner = || -> Result<[f64; 3]> { Ok(reader.coord("a frustum's box")?.map(f64::from)) };
    let index_box: [[f64; 3]; 2] = [corner()?, corner()?];
    let [_, world_from_camera, _, _, _, world_from_local] = matrices(reader)?;
    let mut window = [0.0; 6];
    for number in &mut window {
        *number = reader.f64("a frustum's window")?;
    }
    reader.f64("a frustum's padding")?;
    let [_, local_from_unit_xy, _, local_from_unit_z, _] = matrices(reader)?;
    let world = |x: f64, z: f64| {
        let depth = project(&local_from_unit_z, [x, 0.0, z])[2];
        project(&world_from_local, project(&local_from_unit_xy, [x, 0.0, depth]))
    };
    let width = |z: f64| {
        let (left, right) = (world(0.0, z), world(1.0, z));
        (0..3).map(|i| (right[i] - left[i]).powi(2)).sum::<f64>().sqrt()
    };
    let [near, far] = [window[4], window[5]];
    let (near_width, far_width) = (width(0.0), width(1.0));
    let mut placed = super::diagonal([near_width, near_width, -near_width], [0.0, 0.0, -near]);
    placed = product(&placed, &world_from_camera);
    Ok(Transform {
        type_name: "NonlinearFrustumMap".into(),
        map: Map::Frustum {
            index_box,
            taper: near_width / far_width,
            depth: (far - near) / near_width,
            linear: placed,
        },
    })
}

fn skip_box(reader: &mut Reader<'_>) -> Result<()> {
    reader.skip(24, "a transform's box")
}

fn matrix(reader: &mut Reader<'_>) -> Result<Matrix4> {
    let mut matrix = [[0.0; 4]; 4];
    for value in matrix.iter_mut().flatten() {
        *value = reader.f64("a matrix")?;
    }
    Ok(matrix)
}

fn matrices<const N: usize>(reader: &mut Reader<'_>) -> Result<[Matrix4; N]> {
    let mut all = [[[0.0; 4]; 4]; N];
    for one in &mut all {
        *one = matrix(reader)?;
    }
    Ok(all)
}

/// First `a`, then `b`.
fn product(a: &Matrix4, b: &Matrix4) -> Matrix4 {
    std::array::from_fn(|row| std::array::from_fn(|column| (0..4).map(|i| a[row][i] * b[i][column]).sum()))
}

fn project(m: &Matrix4, p: [f64; 3]) -> [f64; 3] {
    let w = p[0] * m[0][3] + p[1] * m[1][3] + p[2] * m[2][3] + m[3][3];
    apply(m, p).map(|x| x / w)
}
