//! Recipes: their text, their steps, their plan for a frame.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use vdb_edit::recipe::Recipe;

fuzz_target!(|text: &str| {
    if let Ok(recipe) = Recipe::parse(text, Path::new("recipe.toml")) {
        let _ = recipe.plan(&[1]);
    }
});
