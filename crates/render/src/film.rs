//! The picture in memory: scene-linear Rec.709 with premultiplied alpha, and what is done to whole pictures.
//! Nothing here knows how a picture is rendered, encoded ([`output`](crate::output)) or converted to a
//! display's colours ([`color`](crate::color)).

/// The most pixels that one [`Image`] may have: 8192 x 8192, one gibibyte.
pub const MAX_PIXELS: u64 = 1 << 26;

/// A picture size that is empty, or beyond what this renderer holds in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a picture of {width} x {height} pixels is not possible: both sides must be at least 1, and the area at most {MAX_PIXELS} pixels"
)]
pub struct ImageSizeError {
    /// Columns asked for.
    pub width: u32,
    /// Rows asked for.
    pub height: u32,
}

/// The number of pixels of a picture, checked: at least one, at most [`MAX_PIXELS`].
pub fn pixel_count(width: u32, height: u32) -> Result<usize, ImageSizeError> {
    let count = u64::from(width) * u64::from(height);
    let fits = (1..=MAX_PIXELS).contains(&count);
    usize::try_from(count).ok().filter(|_| fits).ok_or(ImageSizeError { width, height })
}

/// A picture: scene-linear Rec.709 red, green, blue, premultiplied by the fourth value, alpha (1 opaque).
///
/// Colour may exceed 1, and may exceed alpha where a volume glows.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `width * height` pixels, row by row from the top, each row from the left.
    pub pixels: Vec<[f32; 4]>,
}

impl Image {
    /// A transparent black picture. Fails when a side is 0 or the area exceeds [`MAX_PIXELS`].
    pub fn new(width: u32, height: u32) -> Result<Self, ImageSizeError> {
        Ok(Self { width, height, pixels: vec![[0.0; 4]; pixel_count(width, height)?] })
    }

    /// This picture in front of an even, opaque background of linear colour: alpha becomes 1.
    #[must_use]
    pub fn over(&self, background: [f32; 3]) -> Self {
        self.map(|[r, g, b, alpha]| {
            let through = 1.0 - alpha;
            [r + through * background[0], g + through * background[1], b + through * background[2], 1.0]
        })
    }

    /// This picture brighter by a number of photographic stops, each of them twice the light; alpha is kept.
    #[must_use]
    pub fn exposed(&self, stops: f32) -> Self {
        let gain = stops.exp2();
        self.map(|[r, g, b, alpha]| [r * gain, g * gain, b * gain, alpha])
    }

    /// Copies `source` into this picture, its top left corner at column `left` and row `top`. What falls
    /// outside is left out. Replaces, does not blend.
    pub fn blit(&mut self, source: &Self, left: u32, top: u32) {
        let columns = source.width.min(self.width.saturating_sub(left)) as usize;
        if columns == 0 {
            return;
        }
        let rows = self.pixels.chunks_exact_mut(self.width as usize).skip(top as usize);
        for (row, from) in rows.zip(source.pixels.chunks_exact(source.width as usize)) {
            let into = row.iter_mut().skip(left as usize);
            into.zip(from).for_each(|(pixel, source)| *pixel = *source);
        }
    }

    /// The mean of every channel over all pixels, summed in double precision; 0 for a picture without pixels.
    pub fn mean(&self) -> [f32; 4] {
        let mut sum = [0.0f64; 4];
        for pixel in &self.pixels {
            sum.iter_mut().zip(pixel).for_each(|(s, p)| *s += f64::from(*p));
        }
        sum.map(|s| (s / self.pixels.len().max(1) as f64) as f32)
    }

    fn map(&self, f: impl Fn([f32; 4]) -> [f32; 4]) -> Self {
        Self { width: self.width, height: self.height, pixels: self.pixels.iter().map(|&p| f(p)).collect() }
    }
}

/// Pictures side by side on an even, opaque ground of linear `colour`: row by row from the top left, `gap` pixels
/// between neighbours and none around them. All cells have the size of the largest picture, and a smaller one
/// lies at the top left of its cell. Fewer pictures than `columns` (at least 1) make a narrower sheet.
///
/// Fails without pictures, and when the sheet would be larger than [`MAX_PIXELS`].
pub fn contact_sheet(
    images: &[Image],
    columns: u32,
    gap: u32,
    colour: [f32; 3],
) -> Result<Image, ImageSizeError> {
    let count = u32::try_from(images.len()).unwrap_or(u32::MAX);
    let columns = columns.clamp(1, count.max(1));
    let cell_width = images.iter().map(|image| image.width).max().unwrap_or(0);
    let cell_height = images.iter().map(|image| image.height).max().unwrap_or(0);
    // A sheet too large for u32 saturates, and is then refused for its area.
    let side = |cells: u32, cell: u32| {
        cells.saturating_mul(cell).saturating_add(gap.saturating_mul(cells.saturating_sub(1)))
    };
    let mut sheet = Image::new(side(columns, cell_width), side(count.div_ceil(columns), cell_height))?;
    sheet.pixels.fill([colour[0], colour[1], colour[2], 1.0]);
    for (i, image) in (0..count).zip(images) {
        sheet.blit(
            image,
            (i % columns) * cell_width.saturating_add(gap),
            (i / columns) * cell_height.saturating_add(gap),
        );
    }
    Ok(sheet)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbered(width: u32, height: u32) -> Image {
        let pixels = (0..width * height).map(|i| [i as f32; 4]).collect();
        Image { width, height, pixels }
    }

    #[test]
    fn impossible_sizes_are_refused() {
        for (width, height) in
            [(0, 5), (5, 0), (0, 0), (u32::MAX, u32::MAX), (1 << 16, 1 << 16), (1 << 26, 2)]
        {
            assert_eq!(Image::new(width, height), Err(ImageSizeError { width, height }));
        }
        assert_eq!(pixel_count(8192, 8192), Ok(1 << 26));
        assert_eq!(Image::new(3, 2).map(|image| image.pixels), Ok(vec![[0.0; 4]; 6]));
    }

    #[test]
    fn over_shows_the_background_through_what_is_missing() {
        let image = Image {
            width: 3,
            height: 1,
            pixels: vec![[0.0; 4], [0.25, 0.5, 0.0, 0.5], [2.0, 0.0, 0.0, 1.0]],
        };
        let over = image.over([1.0, 0.5, 0.25]);
        let expected = [[1.0, 0.5, 0.25, 1.0], [0.75, 0.75, 0.125, 1.0], [2.0, 0.0, 0.0, 1.0]];
        assert_eq!(over.pixels, expected);
        assert_eq!(over.over([9.0; 3]), over);
    }

    #[test]
    fn a_stop_doubles_the_light_and_keeps_alpha() {
        let image = Image { width: 1, height: 1, pixels: vec![[0.5, 1.0, 2.0, 0.5]] };
        assert_eq!(image.exposed(1.0).pixels, [[1.0, 2.0, 4.0, 0.5]]);
        assert_eq!(image.exposed(-2.0).exposed(2.0), image);
    }

    #[test]
    fn blit_copies_what_overlaps_and_nothing_else() {
        let source = numbered(3, 2);
        for (left, top) in [(0, 0), (1, 2), (2, 3), (4, 4), (5, 0), (0, 5), (u32::MAX, u32::MAX)] {
            let mut canvas = Image { width: 5, height: 4, pixels: vec![[-1.0; 4]; 20] };
            canvas.blit(&source, left, top);
            for (i, pixel) in canvas.pixels.iter().enumerate() {
                let (x, y) = ((i as u32 % 5).checked_sub(left), (i as u32 / 5).checked_sub(top));
                let expected = match (x, y) {
                    (Some(x @ 0..3), Some(y @ 0..2)) => (y * 3 + x) as f32,
                    _ => -1.0,
                };
                assert_eq!(*pixel, [expected; 4], "pixel {i} at {left}, {top}");
            }
        }
    }

    #[test]
    fn a_contact_sheet_shows_every_picture_in_its_cell() {
        let colour = [0.25, 0.5, 0.75];
        for (count, columns, gap) in [(5u32, 3u32, 2u32), (4, 2, 0), (1, 4, 9), (3, 1, 1), (2, 0, 1)] {
            let picture = |n: u32| Image { pixels: vec![[n as f32; 4]; 12], width: 4, height: 3 };
            let images: Vec<Image> = (2..2 + count).map(picture).collect();
            let sheet = contact_sheet(&images, columns, gap, colour).unwrap();
            let columns = columns.clamp(1, count);
            let rows = count.div_ceil(columns);
            assert_eq!(
                (sheet.width, sheet.height),
                (columns * (4 + gap) - gap, rows * (3 + gap) - gap),
                "{count} in {columns}"
            );
            for (i, pixel) in (0u32..).zip(&sheet.pixels) {
                let (x, y) = (i % sheet.width, i / sheet.width);
                let n = y / (3 + gap) * columns + x / (4 + gap);
                let inside = x % (4 + gap) < 4 && y % (3 + gap) < 3 && n < count;
                let expected = if inside { [2.0 + n as f32; 4] } else { [0.25, 0.5, 0.75, 1.0] };
                assert_eq!(*pixel, expected, "{x}, {y} of {count} in {columns}");
            }
        }
    }

    #[test]
    fn impossible_contact_sheets_are_refused() {
        assert!(contact_sheet(&[], 4, 1, [0.0; 3]).is_err());
        let pair = [numbered(2, 1), numbered(1, 2)];
        for gap in [u32::MAX, u32::MAX - 1, u32::MAX / 2, 1 << 26] {
            assert!(contact_sheet(&pair, 2, gap, [0.0; 3]).is_err(), "{gap}");
            assert!(contact_sheet(&pair, 1, gap, [0.0; 3]).is_err(), "{gap}");
        }
        assert_eq!(contact_sheet(&pair, 2, 0, [0.0; 3]).map(|sheet| (sheet.width, sheet.height)), Ok((4, 2)));
        // A gap that nobody sees does not matter.
        assert!(contact_sheet(&pair[..1], 1, u32::MAX, [0.0; 3]).is_ok());
    }

    #[test]
    fn mean_is_the_mean() {
        assert_eq!(numbered(4, 4).mean(), [7.5; 4]);
        assert_eq!(Image { width: 0, height: 0, pixels: Vec::new() }.mean(), [0.0; 4]);
    }
}
