//! Pictures in memory. A [`Film`] gathers what the paths of each pixel bring; an [`Image`] is what is looked
//! at: scene-linear Rec.709 with premultiplied alpha, and what is done to whole pictures. Nothing here knows
//! how a picture is rendered ([`progressive`](crate::progressive)), encoded ([`output`](crate::output)) or
//! converted to a display's colours ([`color`](crate::color)).

use glam::Vec3;

use crate::path::PathSample;
use crate::tiling::Tiling;

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

/// What the paths of one pixel brought: sums of what they saw, and how far their light lies from its mean.
///
/// The sums of single in double precision are exact for all that matters: a mean of equal values is that
/// value.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    /// Paths so far.
    pub samples: u32,
    /// How many of them met the medium.
    pub hits: u32,
    /// Sums over all paths.
    pub(crate) emission: [f64; 3],
    pub(crate) direct: [f64; 3],
    pub(crate) indirect: [f64; 3],
    pub(crate) albedo: [f64; 3],
    /// The sum over the paths that met the medium.
    pub(crate) depth: f64,
    /// Sums of squared distances from the mean, of red, green, blue and luminance, by Welford's method: sums
    /// of squares would lose the small differences of bright pixels.
    pub(crate) spread: [f64; 4],
}

impl Tally {
    /// Takes in one path. What is infinite counts as the largest number: means of infinities say nothing.
    pub fn add(&mut self, sample: &PathSample) {
        let before = with_luminance(self.mean_light());
        let finite = |v: Vec3| v.to_array().map(|v| f64::from(v.clamp(f32::MIN, f32::MAX)));
        let parts = [sample.emission, sample.direct, sample.indirect].map(finite);
        self.samples = self.samples.saturating_add(1);
        let sums = [&mut self.emission, &mut self.direct, &mut self.indirect, &mut self.albedo];
        for (sum, value) in sums.into_iter().zip(parts.into_iter().chain([finite(sample.albedo)])) {
            *sum = add(*sum, value);
        }
        if !sample.passed {
            self.hits = self.hits.saturating_add(1);
            self.depth += f64::from(sample.depth);
        }
        let light = with_luminance(parts.into_iter().fold([0.0; 3], add));
        let after = with_luminance(self.mean_light());
        for (i, spread) in self.spread.iter_mut().enumerate() {
            *spread += (light[i] - before[i]) * (light[i] - after[i]);
        }
    }

    /// The mean light of a path.
    pub fn light(&self) -> [f32; 3] {
        self.mean_light().map(|v| v as f32)
    }

    /// The mean light that the medium gives off towards the camera. This, [`Tally::direct`] and
    /// [`Tally::indirect`] make up [`Tally::light`].
    pub fn emission(&self) -> [f32; 3] {
        self.mean(self.emission)
    }

    /// The mean light of lights that scattered once.
    pub fn direct(&self) -> [f32; 3] {
        self.mean(self.direct)
    }

    /// The mean light that scattered more often.
    pub fn indirect(&self) -> [f32; 3] {
        self.mean(self.indirect)
    }

    /// The mean albedo where paths first collide, 0 for those that do not: premultiplied, like the light.
    pub fn albedo(&self) -> [f32; 3] {
        self.mean(self.albedo)
    }

    /// The share of paths that met the medium.
    pub fn alpha(&self) -> f32 {
        (f64::from(self.hits) / f64::from(self.samples.max(1))) as f32
    }

    /// The mean distance from the camera at which paths first collide, in world lengths along the ray, over
    /// those that do; infinite if none does.
    pub fn depth(&self) -> f32 {
        if self.hits == 0 { f32::INFINITY } else { (self.depth / f64::from(self.hits)) as f32 }
    }

    /// The standard errors of red, green, blue and alpha, as far as the paths tell; 0 where there is only
    /// one.
    pub fn standard_error(&self) -> [f32; 4] {
        let [r, g, b, _] = self.spread;
        // A path meets the medium or not, so that the spread follows from the counts.
        let [hits, samples] = [self.hits, self.samples.max(1)].map(f64::from);
        let alpha = hits * (samples - hits) / samples;
        [r, g, b, alpha].map(|spread| self.error_of(spread) as f32)
    }

    /// The standard error of the luminance.
    fn luminance_error(&self) -> f64 {
        self.error_of(self.spread[3])
    }

    fn error_of(&self, spread: f64) -> f64 {
        let freedom = f64::from(self.samples.max(1)) * f64::from(self.samples.max(2) - 1);
        (spread.max(0.0) / freedom).sqrt()
    }

    fn mean_light(&self) -> [f64; 3] {
        let sum = add(add(self.emission, self.direct), self.indirect);
        sum.map(|sum| sum / f64::from(self.samples.max(1)))
    }

    fn mean(&self, sum: [f64; 3]) -> [f32; 3] {
        sum.map(|sum| (sum / f64::from(self.samples.max(1))) as f32)
    }

    /// The same in brighter light.
    fn brighter(mut self, gain: f64) -> Self {
        for light in [&mut self.emission, &mut self.direct, &mut self.indirect] {
            *light = light.map(|v| v * gain);
        }
        self.spread = self.spread.map(|v| v * gain * gain);
        self
    }
}

fn add(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] + b[i])
}

/// Red, green, blue and luminance (ITU-R BT.709-6, part 3).
fn with_luminance([r, g, b]: [f64; 3]) -> [f64; 4] {
    [r, g, b, 0.2126 * r + 0.7152 * g + 0.0722 * b]
}

/// What all paths of a picture brought so far, pixel by pixel. Pixels can have different numbers of paths.
#[derive(Clone, Debug, PartialEq)]
pub struct Film {
    pub(crate) tiling: Tiling,
    /// The pixels of each tile.
    pub(crate) tiles: Vec<Vec<Tally>>,
}

impl Film {
    /// A film that no path has met. Fails when a side is 0 or the area exceeds [`MAX_PIXELS`].
    pub fn new(width: u32, height: u32) -> Result<Self, ImageSizeError> {
        pixel_count(width, height)?;
        let tiling = Tiling { width, height };
        let blank = |tile| vec![Tally::default(); tiling.pixels(tile).count()];
        Ok(Film { tiling, tiles: (0..tiling.count()).map(blank).collect() })
    }

    /// Columns.
    pub fn width(&self) -> u32 {
        self.tiling.width
    }

    /// Rows.
    pub fn height(&self) -> u32 {
        self.tiling.height
    }

    /// What `f` says of each pixel, row by row from the top: `film.map(Tally::depth)`.
    pub fn map<T: Copy + Default>(&self, f: impl Fn(&Tally) -> T) -> Vec<T> {
        self.tiling.rows(self.tiles.iter().map(|tile| tile.iter().map(&f)))
    }

    /// The picture: the mean light of each pixel; alpha is 1 − transmittance. Nothing stands behind the
    /// medium.
    pub fn image(&self) -> Image {
        let pixel = |tally: &Tally| {
            let [r, g, b] = tally.light();
            [r, g, b, tally.alpha()]
        };
        Image { width: self.width(), height: self.height(), pixels: self.map(pixel) }
    }

    /// The fewest and the most paths of a pixel.
    pub fn samples(&self) -> [u32; 2] {
        let all = self.tiles.iter().flatten().map(|tally| tally.samples);
        all.fold([u32::MAX, 0], |[fewest, most], samples| [fewest.min(samples), most.max(samples)])
    }

    /// How noisy the picture is: over the pixels from which any light came, the root mean square of `e / (l +
    /// m / 10)`, where `l` is the luminance of a pixel, `e` its standard error, and `m` the mean of `l` over
    /// these pixels. The last term keeps pixels that are nearly black from deciding alone. Neither exposure
    /// nor empty parts of the picture change the figure.
    ///
    /// Infinite if a pixel has less than two paths; 0 for a black picture.
    pub fn noise(&self) -> f64 {
        if self.samples()[0] < 2 {
            return f64::INFINITY;
        }
        let luminance = |tally: &Tally| with_luminance(tally.mean_light())[3];
        let lit = || self.tiles.iter().flatten().map(|t| (luminance(t), t)).filter(|(l, _)| *l != 0.0);
        let count = lit().count().max(1) as f64;
        let floor = 0.1 * lit().map(|(luminance, _)| luminance).sum::<f64>() / count;
        let squares = lit().map(|(luminance, tally)| (tally.luminance_error() / (luminance + floor)).powi(2));
        (squares.sum::<f64>() / count).sqrt()
    }

    /// The same film in light brighter by a number of photographic stops, as [`Image::exposed`].
    #[must_use]
    pub fn exposed(&self, stops: f32) -> Self {
        let gain = f64::from(stops.exp2());
        let brighter = |tile: &Vec<Tally>| tile.iter().map(|tally| tally.brighter(gain)).collect();
        Film { tiling: self.tiling, tiles: self.tiles.iter().map(brighter).collect() }
    }
}

/// Pictures side by side on an even, opaque ground of linear `colour`: row by row from the top left, `gap`
/// pixels between neighbours and none around them. All cells have the size of the largest picture, and a
/// smaller one lies at the top left of its cell. Fewer pictures than `columns` (at least 1) make a narrower
/// sheet.
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
    use crate::hash::{hash_pixel, unit_f32};

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

    /// A path whose numbers all follow from `i`.
    fn sample(i: u32) -> PathSample {
        let value = |d| unit_f32(hash_pixel(i, 7, 0, d)) * 2.0;
        let colour = |d| Vec3::new(value(d), value(d + 1), value(d + 2));
        let passed = value(20) < 0.7;
        let depth = if passed { 0.0 } else { value(12) + 3.0 };
        PathSample {
            emission: colour(0),
            direct: colour(3),
            indirect: colour(6),
            passed,
            depth,
            albedo: colour(9),
        }
    }

    #[test]
    fn tallies_are_means_and_their_errors() {
        let mut tally = Tally::default();
        assert_eq!((tally.light(), tally.alpha(), tally.depth()), ([0.0; 3], 0.0, f32::INFINITY));
        let samples: Vec<PathSample> = (0..1000).map(sample).collect();
        samples.iter().for_each(|sample| tally.add(sample));
        // The same by the book, in two passes over all that came.
        let check = |found: f32, error: Option<f32>, values: &dyn Fn(&PathSample) -> f64| {
            let mean = samples.iter().map(values).sum::<f64>() / 1000.0;
            let squares = samples.iter().map(|sample| (values(sample) - mean).powi(2)).sum::<f64>();
            assert!((f64::from(found) - mean).abs() < 1e-6, "{found} {mean}");
            let expected = (squares / 999.0 / 1000.0).sqrt();
            assert!(
                error.is_none_or(|error| (f64::from(error) - expected).abs() < 1e-7),
                "{error:?} {expected}"
            );
        };
        let errors = tally.standard_error();
        for (c, error) in errors.into_iter().enumerate().take(3) {
            check(tally.light()[c], Some(error), &|s| {
                f64::from(s.emission[c]) + f64::from(s.direct[c]) + f64::from(s.indirect[c])
            });
            check(tally.emission()[c], None, &|s| s.emission[c].into());
            check(tally.direct()[c], None, &|s| s.direct[c].into());
            check(tally.indirect()[c], None, &|s| s.indirect[c].into());
            check(tally.albedo()[c], None, &|s| s.albedo[c].into());
        }
        check(tally.alpha(), Some(errors[3]), &|s| f64::from(u8::from(!s.passed)));
        let hits: Vec<f64> = samples.iter().filter(|s| !s.passed).map(|s| s.depth.into()).collect();
        let depth = hits.iter().sum::<f64>() / hits.len() as f64;
        assert!(hits.len() < 1000 && (f64::from(tally.depth()) - depth).abs() < 1e-6);
    }

    #[test]
    fn equal_paths_have_no_spread_and_infinite_ones_a_finite_mean() {
        for value in [0.1, 1e30, f32::MAX, f32::INFINITY] {
            let mut tally = Tally::default();
            let sample = PathSample { direct: Vec3::splat(value), ..sample(1) };
            let sample = PathSample { emission: Vec3::ZERO, indirect: Vec3::ZERO, ..sample };
            (0..100).for_each(|_| tally.add(&sample));
            assert_eq!(tally.light(), [value.min(f32::MAX); 3]);
            assert_eq!(tally.standard_error()[..3], [0.0; 3]);
        }
    }

    #[test]
    fn noise_is_relative_and_known() {
        let mut film = Film::new(20, 18).unwrap();
        assert_eq!(film.noise(), f64::INFINITY);
        // Half of the picture stays black; the other half has a standard error of 10 % and a floor of as
        // much.
        let grey = |value| PathSample { direct: Vec3::splat(value), ..PathSample::default() };
        for (i, tally) in film.tiles.iter_mut().flatten().enumerate() {
            for value in [0.9, 1.1] {
                tally.add(&grey(if i % 2 == 0 { value } else { 0.0 }));
            }
        }
        assert!((film.noise() - 0.1 / 1.1).abs() < 1e-6, "{}", film.noise());
        let brighter = film.exposed(3.0);
        assert!((brighter.noise() - film.noise()).abs() < 1e-12);
        assert_eq!(brighter.image(), film.image().exposed(3.0));
        assert_eq!(film.samples(), [2, 2]);
    }
}
