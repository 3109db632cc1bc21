//! How a picture is cut into tiles, the units of work of threads, and in which order pixels follow each other.
//!
//! Tiles and the packets in them follow a Hilbert curve: rays that are near each other go through the same bricks, and the curve
//! comes back to what is near soon, whatever the size of the cache. Which thread makes a tile is not decided here.

use crate::packet::{RAYS, SIDE, square};

/// Pixels per side of a tile.
const TILE: u32 = 16;

/// How a picture is cut into tiles, and in which order they are made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tiling {
    /// The width of the picture, in pixels.
    pub width: u32,
    /// The height of the picture, in pixels.
    pub height: u32,
}

impl Tiling {
    /// How many tiles there are.
    pub fn count(self) -> u32 {
        self.width.div_ceil(TILE) * self.height.div_ceil(TILE)
    }

    /// Column and row of each pixel of a tile, row by row.
    pub(crate) fn pixels(self, tile: u32) -> impl Iterator<Item = [u32; 2]> {
        let ([left, top], [across, down], _) = self.tile(tile);
        (0..across * down).map(move |i| [left + i % across, top + i / across])
    }

    /// The squares of a tile whose rays make packets. Those at the right and at the bottom may reach beyond the picture.
    ///
    /// # Panics
    /// If there is no such tile.
    pub fn squares(self, tile: u32) -> impl Iterator<Item = [[u32; 2]; RAYS]> {
        let ([left, top], size, turn) = self.tile(tile);
        let [columns, rows] = size.map(|pixels| pixels.div_ceil(SIDE));
        (0..columns * rows).map(move |i| {
            let ([column, row], _) = along_curve(i, columns, rows, TILE / SIDE, turn);
            square(left + column * SIDE, top + row * SIDE)
        })
    }

    /// The first pixel of a tile, how many there are along each side, and how the curve goes through it.
    fn tile(self, tile: u32) -> ([u32; 2], [u32; 2], Turn) {
        let [columns, rows] = [self.width.div_ceil(TILE), self.height.div_ceil(TILE)];
        let side = columns.max(rows).next_power_of_two();
        let ([column, row], turn) = along_curve(tile, columns, rows, side, Turn::default());
        let [left, top] = [column * TILE, row * TILE];
        ([left, top], [TILE.min(self.width - left), TILE.min(self.height - top)], turn)
    }

    /// The pixels of the whole picture, row by row, from those of all tiles.
    pub(crate) fn rows<P: Copy + Default>(
        self,
        tiles: impl IntoIterator<Item = impl IntoIterator<Item = P>>,
    ) -> Vec<P> {
        let mut all = vec![P::default(); self.width as usize * self.height as usize];
        for (tile, pixels) in (0..).zip(tiles) {
            for ([x, y], pixel) in self.pixels(tile).zip(pixels) {
                all[y as usize * self.width as usize + x as usize] = pixel;
            }
        }
        all
    }
}

/// How a Hilbert curve goes through a square: from one corner to a neighbour of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Turn {
    /// Columns and rows change places: the curve ends right above or below where it begins, not beside it.
    is_upright: bool,
    /// It begins at the last column and row, not at the first.
    is_reversed: bool,
}

/// Column and row of a place along the Hilbert curve through a square, a power of two of cells per `side`, of which only the first
/// `columns` and `rows` count; and how the curve goes through that cell.
///
/// # Panics
/// If there is no such place.
fn along_curve(mut place: u32, columns: u32, rows: u32, mut side: u32, mut turn: Turn) -> ([u32; 2], Turn) {
    let [mut column, mut row] = [0, 0];
    while side > 1 {
        side /= 2;
        let inside = |first: u32, end: u32| end.saturating_sub(first).min(side);
        // The quarters in the order of the curve that begins at the first cell and ends beside it.
        let quarter = (0..4).find_map(|quarter: u32| {
            let gray = quarter ^ quarter >> 1;
            let [mut across, mut down] = [gray >> 1, gray & 1];
            if turn.is_upright {
                (across, down) = (down, across);
            }
            if turn.is_reversed {
                (across, down) = (1 - across, 1 - down);
            }
            let corner = [column + across * side, row + down * side];
            let count = inside(corner[0], columns) * inside(corner[1], rows);
            if place < count {
                return Some((quarter, corner));
            }
            place -= count;
            None
        });
        let (quarter, corner) = quarter.expect("a place along the curve");
        [column, row] = corner;
        // So that each quarter begins beside the end of the one before.
        if quarter == 0 || quarter == 3 {
            turn.is_upright = !turn.is_upright;
        }
        if quarter == 3 {
            turn.is_reversed = !turn.is_reversed;
        }
    }
    ([column, row], turn)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_cover_each_pixel_once() {
        for (width, height) in [(1, 1), (16, 16), (17, 1), (50, 33), (16, 700)] {
            let tiling = Tiling { width, height };
            let tiles: Vec<Vec<[u32; 2]>> =
                (0..tiling.count()).map(|tile| tiling.pixels(tile).collect()).collect();
            assert_eq!(tiles.iter().flatten().count(), (width * height) as usize);
            let rows = tiling.rows(tiles);
            let expected = (0..width * height).map(|i| [i % width, i / width]);
            assert!(rows.into_iter().eq(expected));
        }
    }

    #[test]
    fn squares_cover_the_pixels_of_their_tile() {
        for (width, height) in [(1, 1), (64, 64), (50, 33)] {
            let tiling = Tiling { width, height };
            for tile in 0..tiling.count() {
                let mut squares: Vec<[u32; 2]> = tiling.squares(tile).flatten().collect();
                squares.retain(|[x, y]| *x < width && *y < height);
                squares.sort_by_key(|[x, y]| [*y, *x]);
                assert!(squares.into_iter().eq(tiling.pixels(tile)));
            }
        }
    }

    #[test]
    fn squares_of_a_whole_picture_lie_side_by_side() {
        let tiling = Tiling { width: 256, height: 256 };
        let corners: Vec<[u32; 2]> =
            (0..tiling.count()).flat_map(|tile| tiling.squares(tile)).map(|square| square[0]).collect();
        for pair in corners.windows(2) {
            assert_eq!(pair[0][0].abs_diff(pair[1][0]) + pair[0][1].abs_diff(pair[1][1]), SIDE, "{pair:?}");
        }
    }
}
