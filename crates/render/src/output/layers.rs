//! One OpenEXR file with all that a film knows: the picture and what it is made of, as layers of one part.
//!
//! | channels | what |
//! | --- | --- |
//! | `R` `G` `B` `A` | the picture, as the caller passes it |
//! | `emission.` `direct.` `indirect.` + `R` `G` `B` | its light in three parts, before anything stands behind it |
//! | `albedo.` + `R` `G` `B` | the albedo where paths first collide, premultiplied |
//! | `transmittance.Y` | 1 − alpha of the film, whatever the picture's alpha |
//! | `Z` | mean distance of first collisions along the ray, in world lengths; infinite without any |
//! | `standard_error.` + `R` `G` `B` `A` | of the film's light and alpha |
//! | `samples.Y` | paths of the pixel |
//!
//! `Z` and `samples.Y` are 32-bit floats in files of either precision; distances beyond 65504 are common.
//! What the scene was is written as attributes of type `string`, in UTF-8.
//!
//! Plain pictures are [`exr`](super::exr)'s.

use std::io::Cursor;

use exr::prelude::{
    AnyChannel, AnyChannels, AttributeValue, Encoding, FlatSamples, LayerAttributes, Text, Vec2,
    WritableImage,
};

use super::exr::{ExrPrecision, to_half};
use super::{OutputError, check};
use crate::film::{Film, Image, Tally};

/// A film as an OpenEXR file of several layers. `beauty` is its picture, with whatever was done to it (a
/// background, less noise); `attributes` are names and values for the file's head.
///
/// The same film gives the same bytes.
///
/// # Errors
/// If the picture is not of the film's size, an attribute's name is empty, longer than 255 bytes, given twice
/// or one that OpenEXR defines, or if the encoder refuses.
pub fn encode_layers(
    beauty: &Image,
    film: &Film,
    attributes: &[(&str, &str)],
    precision: ExrPrecision,
) -> Result<Vec<u8>, OutputError> {
    check(beauty)?;
    if (beauty.width, beauty.height) != (film.width(), film.height()) {
        return Err(OutputError::Misuse("picture and film must have one size".into()));
    }
    let refused = |reason: String| OutputError::Encode { format: "OpenEXR", reason };
    let mut layer = LayerAttributes { software_name: Some("nuage".into()), ..LayerAttributes::default() };
    for (name, value) in attributes {
        let [name_text, value] = [name, value].map(|text| Text::from_slice_unchecked(text.as_bytes()));
        if layer.other.insert(name_text, AttributeValue::Text(value)).is_some() || name.contains('\0') {
            return Err(OutputError::Misuse(format!(
                "attribute '{name}' is there twice, or has no proper name"
            )));
        }
    }
    let size = Vec2(beauty.width as usize, beauty.height as usize);
    let channels = AnyChannels::sort(channels(beauty, film, precision).into());
    let layer = exr::prelude::Layer::new(size, layer, Encoding::SMALL_LOSSLESS, channels);
    let picture = exr::prelude::Image::from_layer(layer);
    let writer = picture.write();
    let writer = if cfg!(feature = "parallel") { writer } else { writer.non_parallel() };
    let mut file = Cursor::new(Vec::new());
    writer.to_buffered(&mut file).map_err(|error| refused(error.to_string()))?;
    let mut file = file.into_inner();
    sort_attributes(&mut file).ok_or_else(|| refused("its head makes no sense".into()))?;
    Ok(file)
}

/// One of the colours of a pixel.
type Colour = fn(&Tally) -> [f32; 3];

fn channels(beauty: &Image, film: &Film, precision: ExrPrecision) -> Vec<AnyChannel<FlatSamples>> {
    let exact = |name: &str, values: Vec<f32>| AnyChannel::new(name, FlatSamples::F32(values));
    let channel = |name: &str, values: Vec<f32>| match precision {
        ExrPrecision::Float => exact(name, values),
        ExrPrecision::Half => {
            AnyChannel::new(name, FlatSamples::F16(values.into_iter().map(to_half).collect()))
        }
    };
    let mut channels = vec![
        channel("transmittance.Y", film.map(|tally| 1.0 - tally.alpha())),
        exact("Z", film.map(Tally::depth)),
        exact("samples.Y", film.map(|tally| tally.samples as f32)),
    ];
    let colours: [(&str, Colour); 4] = [
        ("emission", Tally::emission),
        ("direct", Tally::direct),
        ("indirect", Tally::indirect),
        ("albedo", Tally::albedo),
    ];
    for (i, component) in ["R", "G", "B", "A"].into_iter().enumerate() {
        channels.push(channel(component, beauty.pixels.iter().map(|pixel| pixel[i]).collect()));
        let error = film.map(|tally| tally.standard_error()[i]);
        channels.push(channel(&format!("standard_error.{component}"), error));
        for (layer, colour) in colours.iter().filter(|_| i < 3) {
            channels.push(channel(&format!("{layer}.{component}"), film.map(|tally| colour(tally)[i])));
        }
    }
    channels
}

/// Puts the attributes of a file's head in the order of their names: the encoder's own order is that of a
/// hash map, which differs from run to run. `None` if the bytes are no such file.
fn sort_attributes(file: &mut [u8]) -> Option<()> {
    // Magic number and version, then name, type, size and value of each attribute, then an empty name.
    let first = 8;
    let mut end = first;
    let mut attributes = Vec::new();
    while *file.get(end)? != 0 {
        let begin = end;
        for _ in 0..2 {
            end += file.get(end..)?.iter().position(|byte| *byte == 0)? + 1;
        }
        let size = u32::from_le_bytes(*file.get(end..)?.first_chunk()?);
        end = end.checked_add(4 + size as usize)?;
        attributes.push(file.get(begin..end)?.to_vec());
    }
    attributes.sort_unstable();
    file.get_mut(first..end)?.copy_from_slice(&attributes.concat());
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hash::{hash_pixel, unit_f32};
    use crate::path::PathSample;
    use exr::prelude::{ReadChannels, ReadLayers, f16, read};
    use glam::Vec3;

    fn film(width: u32, height: u32) -> Film {
        let mut film = Film::new(width, height).unwrap();
        for (i, tally) in (0..).zip(film.tiles.iter_mut().flatten()) {
            for path in 0..i % 4 {
                let value = |d| unit_f32(hash_pixel(i, path, 3, d)) * 3.0;
                let colour = |d| Vec3::new(value(d), value(d + 1), value(d + 2));
                let [emission, direct, indirect, albedo] = [0, 3, 6, 9].map(colour);
                let passed = value(12) > 1.5;
                tally.add(&PathSample { emission, direct, indirect, passed, depth: 1e5 * value(13), albedo });
            }
        }
        film
    }

    type Attributes = Vec<(String, String)>;

    /// Names and values of all channels, and the attributes, by an `exr` reader.
    fn decode(file: &[u8]) -> (Vec<(String, FlatSamples)>, Attributes) {
        let reader = read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
        let picture = reader.all_attributes().from_buffered(Cursor::new(file)).unwrap();
        let layer = picture.layer_data;
        let text = |text: &Text| String::from_utf8(text.as_slice().to_vec()).unwrap();
        let other = layer.attributes.other.iter().filter_map(|(name, value)| match value {
            AttributeValue::Text(value) => Some((text(name), text(value))),
            _ => None,
        });
        let mut other: Vec<_> = other.collect();
        other.sort();
        let channels = layer.channel_data.list.into_iter();
        (channels.map(|channel| (channel.name.to_string(), channel.sample_data)).collect(), other)
    }

    #[test]
    fn layers_come_back_and_make_up_the_picture() {
        let film = film(37, 20);
        let attributes =
            [("nuage/scene", "density = 3\nrötlich"), ("nuage/a name of more than 31 bytes", "")];
        let bytes = encode_layers(&film.image(), &film, &attributes, ExrPrecision::Float).unwrap();
        let (channels, found) = decode(&bytes);
        let names: Vec<&str> = channels.iter().map(|(name, _)| name.as_str()).collect();
        let mut expected = vec!["A", "B", "G", "R", "Z", "samples.Y", "transmittance.Y"];
        let layers = [
            ("albedo", "BGR"),
            ("direct", "BGR"),
            ("emission", "BGR"),
            ("indirect", "BGR"),
            ("standard_error", "ABGR"),
        ];
        let layers: Vec<String> =
            layers.iter().flat_map(|(layer, c)| c.chars().map(move |c| format!("{layer}.{c}"))).collect();
        expected.extend(layers.iter().map(String::as_str));
        expected.sort_unstable();
        assert_eq!(names, expected);
        assert_eq!(found.len(), 2);
        for (name, value) in attributes {
            assert!(found.contains(&(name.into(), value.into())), "{name}");
        }
        let values = |name: &str| {
            let channel = channels.iter().find(|channel| channel.0 == name).expect("the channel");
            match &channel.1 {
                FlatSamples::F32(values) => values.clone(),
                other => panic!("{name} is {:?}", other.value_by_flat_index(0)),
            }
        };
        assert_eq!(values("Z"), film.map(Tally::depth));
        assert_eq!(values("samples.Y"), film.map(|tally| tally.samples as f32));
        assert_eq!(values("standard_error.A"), film.map(|tally| tally.standard_error()[3]));
        assert_eq!(values("albedo.G"), film.map(|tally| tally.albedo()[1]));
        assert_eq!(values("B"), film.map(|tally| tally.light()[2]));
        for c in ["R", "G", "B"] {
            let [emission, direct, indirect] =
                ["emission", "direct", "indirect"].map(|layer| values(&format!("{layer}.{c}")));
            for (i, light) in values(c).into_iter().enumerate() {
                let sum = emission[i] + direct[i] + indirect[i];
                assert!((sum - light).abs() <= 2e-7 * light, "{c} of {i}: {sum} {light}");
            }
        }
        for (alpha, through) in values("A").into_iter().zip(values("transmittance.Y")) {
            assert_eq!(alpha + through, 1.0);
        }
    }

    #[test]
    fn half_files_keep_distances_and_counts() {
        let film = film(20, 5);
        let (channels, _) = decode(&encode_layers(&film.image(), &film, &[], ExrPrecision::Half).unwrap());
        for (name, values) in channels {
            let exact = matches!(values, FlatSamples::F32(_));
            assert_eq!(exact, matches!(name.as_str(), "Z" | "samples.Y"), "{name}");
            if let ("direct.R", FlatSamples::F16(values)) = (name.as_str(), values) {
                assert_eq!(values, film.map(|tally| f16::from_f32(tally.direct()[0])));
            }
        }
    }

    #[test]
    fn same_film_same_bytes() {
        let film = film(70, 40);
        let names: Vec<String> = (0..20).map(|i| format!("nuage/setting {i}")).collect();
        let attributes: Vec<(&str, &str)> = names.iter().map(|name| (name.as_str(), "value")).collect();
        let encode = || encode_layers(&film.image(), &film, &attributes, ExrPrecision::Half).unwrap();
        let first = encode();
        assert!((0..5).all(|_| encode() == first));
    }

    #[test]
    fn bad_layers_are_refused() {
        let (film, image) = (film(3, 3), Image::new(3, 4).unwrap());
        assert!(matches!(encode_layers(&image, &film, &[], ExrPrecision::Half), Err(OutputError::Misuse(_))));
        let long = "a".repeat(256);
        let bad: [&[(&str, &str)]; 5] = [
            &[("", "a")],
            &[(&long, "a")],
            &[("a", "b"), ("a", "c")],
            &[("a\0b", "c")],
            &[("channels", "a")],
        ];
        for attributes in bad {
            assert!(
                encode_layers(&film.image(), &film, attributes, ExrPrecision::Half).is_err(),
                "{attributes:?}"
            );
        }
    }
}
