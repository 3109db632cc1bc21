//! Values on the command line: vectors, colours, sizes and the words that stand for them.

use std::str::FromStr;

use glam::{DVec3, Vec3};
use nuage_render::framing;

/// Numbers separated by commas.
fn numbers(text: &str) -> Result<Vec<f64>, String> {
    let number = |part: &str| match part.trim().parse::<f64>() {
        Ok(x) if x.is_finite() => Ok(x),
        _ => Err(format!("'{part}' is not a number")),
    };
    text.split(',').map(number).collect()
}

/// `x,y,z`.
pub(crate) fn vec3(text: &str) -> Result<DVec3, String> {
    match numbers(text)?.as_slice() {
        [x, y, z] => Ok(DVec3::new(*x, *y, *z)),
        _ => Err("three numbers with commas are needed, as in 1,2.5,-3".into()),
    }
}

/// `r,g,b` or one number for all three; not negative.
pub(crate) fn rgb(text: &str) -> Result<[f32; 3], String> {
    let channels = match numbers(text)?.as_slice() {
        [grey] => [*grey; 3],
        [r, g, b] => [*r, *g, *b],
        _ => return Err("one number, or red,green,blue with commas, is needed".into()),
    };
    let channels = channels.map(|c| c as f32);
    match channels.iter().all(|c| *c >= 0.0 && c.is_finite()) {
        true => Ok(channels),
        false => Err("a number is needed that is not negative and not above 3e38".into()),
    }
}

/// `x,y,z` or one number for all three; none is 0.
pub(crate) fn scale(text: &str) -> Result<DVec3, String> {
    let scale = match numbers(text)?.as_slice() {
        [all] => DVec3::splat(*all),
        [x, y, z] => DVec3::new(*x, *y, *z),
        _ => return Err("one number or three are needed".into()),
    };
    if scale.cmpne(DVec3::ZERO).all() { Ok(scale) } else { Err("a scale of 0 makes a volume flat".into()) }
}

/// An angular diameter of a sun in degrees.
pub(crate) fn sun_angle(text: &str) -> Result<f32, String> {
    match text.trim().parse::<f32>() {
        Ok(angle) if (0.0..180.0).contains(&angle) => Ok(angle),
        _ => Err("an angle from 0 to less than 180 degrees is needed".into()),
    }
}

/// The full angle of a cone in degrees.
pub(crate) fn cone(text: &str) -> Result<f32, String> {
    match text.trim().parse::<f32>() {
        Ok(angle) if angle > 0.0 && angle <= 360.0 => Ok(angle),
        _ => Err("an angle above 0 and up to 360 degrees is needed".into()),
    }
}

/// A vector at length 1; as it is, if it has that length already, so that what was written is what is read. `None` for 0.
pub(crate) fn of_length_1(vector: DVec3) -> Option<DVec3> {
    if (vector.length_squared() - 1.0).abs() < 1e-6 { Some(vector) } else { vector.try_normalize() }
}

/// Albedo: as [`rgb`], at most 1.
pub(crate) fn albedo(text: &str) -> Result<[f32; 3], String> {
    let albedo = rgb(text)?;
    match albedo.iter().all(|c| *c <= 1.0) {
        true => Ok(albedo),
        false => Err("an albedo lies between 0 and 1".into()),
    }
}

/// A finite number above zero.
pub(crate) fn positive(text: &str) -> Result<f32, String> {
    match text.trim().parse::<f32>() {
        Ok(x) if x > 0.0 && x.is_finite() => Ok(x),
        _ => Err("a number above zero is needed".into()),
    }
}

/// A phase function's g.
pub(crate) fn phase(text: &str) -> Result<f32, String> {
    match text.trim().parse::<f32>() {
        Ok(g) if g > -1.0 && g < 1.0 => Ok(g),
        _ => Err("a number between -1 and 1 is needed".into()),
    }
}

/// A finite number.
pub(crate) fn finite(text: &str) -> Result<f32, String> {
    match text.trim().parse::<f32>() {
        Ok(x) if x.is_finite() => Ok(x),
        _ => Err("a number is needed".into()),
    }
}

/// A field of view in degrees.
pub(crate) fn field_of_view(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(x) if x > 0.0 && x < 180.0 => Ok(x),
        _ => Err("an angle between 0 and 180 degrees is needed".into()),
    }
}

/// A picture size, `WIDTHxHEIGHT`, `WIDTH,HEIGHT` or one number for a square.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) width: u32,
    pub(crate) height: u32,
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let side = |part: &str| part.trim().parse::<u32>().ok().filter(|n| *n > 0);
        let (width, height) = text.split_once(['x', 'X', ',']).unwrap_or((text, text));
        match (side(width), side(height)) {
            (Some(width), Some(height)) => match nuage_render::film::pixel_count(width, height) {
                Ok(_) => Ok(Size { width, height }),
                Err(error) => Err(error.to_string()),
            },
            _ => Err("a size in pixels is needed, as in 1024x768".into()),
        }
    }
}

/// An automatic value, or one given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Auto {
    /// Chosen from the volume.
    Auto,
    /// As given.
    Value(f32),
}

impl FromStr for Auto {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Auto::Auto),
            _ => match text.trim().parse::<f32>() {
                Ok(x) if x >= 0.0 && x.is_finite() => Ok(Auto::Value(x)),
                _ => Err("'auto' or a number that is not negative is needed".into()),
            },
        }
    }
}

/// Where the sun stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum SunPosition {
    /// There is none.
    None,
    /// Azimuth and elevation in degrees.
    Angles(f64, f64),
    /// The direction to the sun.
    Direction(DVec3),
}

impl FromStr for SunPosition {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "none" {
            return Ok(SunPosition::None);
        }
        match numbers(text)?.as_slice() {
            [azimuth, elevation] => Ok(SunPosition::Angles(*azimuth, *elevation)),
            [x, y, z] if [x, y, z].iter().any(|c| **c != 0.0) => {
                Ok(SunPosition::Direction(DVec3::new(*x, *y, *z)))
            }
            _ => Err("azimuth,elevation in degrees, or a direction x,y,z, or 'none' is needed".into()),
        }
    }
}

impl SunPosition {
    /// The direction to the sun, of length 1.
    pub(crate) fn direction(self, z_up: bool) -> Option<Vec3> {
        match self {
            SunPosition::None => None,
            SunPosition::Angles(azimuth, elevation) => Some(framing::direction(azimuth, elevation, z_up)),
            SunPosition::Direction(direction) => Some(direction.normalize_or(DVec3::Y).as_vec3()),
        }
    }
}

/// What stands behind the medium.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Background {
    /// Nothing: the picture keeps its alpha.
    None,
    /// The sky's radiance.
    Sky,
    /// A radiance.
    Rgb([f32; 3]),
}

impl FromStr for Background {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "none" => Ok(Background::None),
            "sky" => Ok(Background::Sky),
            _ => rgb(text)
                .map(Background::Rgb)
                .map_err(|e| format!("'none', 'sky' or a colour is needed: {e}")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_read_as_documented() {
        assert_eq!(vec3("1,-2.5,3e2"), Ok(DVec3::new(1.0, -2.5, 300.0)));
        assert!(vec3("1,2").is_err() && vec3("1,2,nan").is_err() && vec3("a,b,c").is_err());
        assert_eq!(rgb("0.5"), Ok([0.5; 3]));
        assert!(rgb("-1").is_err() && rgb("1,2").is_err());
        assert_eq!("64x32".parse(), Ok(Size { width: 64, height: 32 }));
        assert_eq!("64".parse(), Ok(Size { width: 64, height: 64 }));
        assert!("0x5".parse::<Size>().is_err() && "99999999x99999999".parse::<Size>().is_err());
        assert_eq!("auto".parse(), Ok(Auto::Auto));
        assert!("-1".parse::<Auto>().is_err());
        assert_eq!("none".parse(), Ok(SunPosition::None));
        assert_eq!("30,45".parse(), Ok(SunPosition::Angles(30.0, 45.0)));
        assert!("0,0,0".parse::<SunPosition>().is_err());
        assert_eq!("0,0.5,1".parse(), Ok(Background::Rgb([0.0, 0.5, 1.0])));
        assert!(phase("1").is_err() && phase("-0.5").is_ok());
        assert!(albedo("1.5").is_err());
    }

    #[test]
    fn the_sun_stands_where_its_angles_say() {
        let close = |angles: &str, z_up, want: Vec3| {
            let sun: SunPosition = angles.parse().unwrap();
            assert!((sun.direction(z_up).unwrap() - want).length() < 1e-6, "{angles}");
        };
        close("0,0", false, Vec3::Z);
        close("90,0", false, Vec3::X);
        close("0,90", false, Vec3::Y);
        close("0,0", true, Vec3::NEG_Y);
        close("90,0", true, Vec3::X);
        close("10,90", true, Vec3::Z);
    }
}
