//! Depths of OpenEXR pictures: the channel `Z` or `depth`, else the only one.

use std::io::Cursor;
use std::path::Path;

use ::exr::meta::MetaData;
use ::exr::prelude::{ReadChannels, ReadLayers, read as reader};

use super::MOST_PIXELS;
use crate::error::{EditError, Result};

/// Width, height and numbers row by row.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<(usize, usize, Vec<f32>)> {
    let refused = |e: ::exr::error::Error| EditError::input(path, format!("is no picture that can be read: {e}"));
    let facts = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(refused)?;
    // The reader allocates what the header says.
    if facts.headers.iter().any(|header| header.layer_size.area() as f64 > MOST_PIXELS) {
        return Err(EditError::input(path, "has too many pixels"));
    }
    let picture = reader()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .non_parallel()
        .from_buffered(Cursor::new(bytes))
        .map_err(refused)?;
    let channels =
        || picture.layer_data.iter().flat_map(|layer| layer.channel_data.list.iter().map(move |c| (layer, c)));
    let is_depth = |name: &str| ["z", "depth", "depth.z", "depth.v"].contains(&name.to_lowercase().as_str());
    let named = channels().find(|(_, channel)| is_depth(&channel.name.to_string()));
    let only = || channels().next().filter(|_| channels().count() == 1);
    let Some((layer, channel)) = named.or_else(only) else {
        let names: Vec<String> = channels().map(|(_, channel)| channel.name.to_string()).collect();
        return Err(EditError::input(path, format!("has the channels {}: one named Z is wanted", names.join(", "))));
    };
    let depths: Vec<f32> = channel.sample_data.values_as_f32().collect();
    match depths.len() == layer.size.area() {
        true => Ok((layer.size.width(), layer.size.height(), depths)),
        false => Err(EditError::input(path, "a depth for each pixel is wanted")),
    }
}
