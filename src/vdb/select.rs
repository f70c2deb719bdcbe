//! Which grid of a file is meant.

use super::listing::GridListing;

/// The level set that `selector` names, or the reason why there is none.
///
/// `NAME`, `NAME[n]` for the n-th (from 0) of several of one name, and the empty name for an unnamed grid; without a
/// selector the only level set. Grids whose class was never set count as level sets if `assume_level_set`.
pub(super) fn select_level_set(
    grids: &[GridListing],
    selector: Option<&str>,
    assume_level_set: bool,
) -> Result<usize, String> {
    let index = match selector {
        Some(selector) => named(grids, selector)?,
        None => only_level_set(grids, assume_level_set)?,
    };
    check_level_set(&grids[index], assume_level_set)?;
    Ok(index)
}

/// The grid that `selector` names, or the reason why there is none.
pub(super) fn named(grids: &[GridListing], selector: &str) -> Result<usize, String> {
    let matches: Vec<usize> = (0..grids.len()).filter(|&i| grids[i].name == selector).collect();
    match matches[..] {
        [index] => return Ok(index),
        [] => {}
        _ => {
            return Err(format!(
                "{} grids are called `{selector}`: {}; take one by its number",
                matches.len(),
                list(matches.iter().map(|&i| &grids[i]))
            ));
        }
    }
    let numbered = grids.iter().position(|g| g.selector == selector);
    numbered.ok_or_else(|| format!("there is no grid `{selector}`; the file holds {}", list(grids)))
}

fn only_level_set(grids: &[GridListing], assume_level_set: bool) -> Result<usize, String> {
    let of = |f: &dyn Fn(&GridListing) -> bool| (0..grids.len()).filter(|&i| f(&grids[i])).collect::<Vec<_>>();
    let mut found = of(&|g| g.is_level_set() && g.is_scalar());
    if found.is_empty() && assume_level_set {
        found = of(&|g| g.class == "unknown" && g.is_scalar());
    }
    match found[..] {
        [index] => Ok(index),
        // The only grid: its own refusal says more than "no level set".
        [] if grids.len() == 1 => Ok(0),
        [] => Err(format!("there is no level set in it; the file holds {}", list(grids))),
        _ => Err(format!(
            "it holds several level sets: {}; choose one by its name (--grid)",
            list(found.iter().map(|&i| &grids[i]))
        )),
    }
}

/// Refuses grids that hold no distances.
fn check_level_set(grid: &GridListing, assume_level_set: bool) -> Result<(), String> {
    if !grid.is_scalar() {
        return Err(format!(
            "grid `{}` holds {} values ({}); a level set holds float or double",
            grid.selector, grid.value_type, grid.class
        ));
    }
    if grid.is_level_set() || (assume_level_set && grid.class == "unknown") {
        return Ok(());
    }
    Err(match grid.class.as_str() {
        "unknown" => format!(
            "the class of grid `{}` was never set; if it holds signed distances, say so with --assume-level-set",
            grid.selector
        ),
        class => format!(
            "grid `{}` is a {class}, not a level set; a surface can be made of it by `convert --iso`",
            grid.selector
        ),
    })
}

fn list<'a>(grids: impl IntoIterator<Item = &'a GridListing>) -> String {
    let names: Vec<String> = grids.into_iter().map(GridListing::summary).collect();
    if names.is_empty() { "no grid".into() } else { names.join(", ") }
}
