//! Pages of values that are no longer in use, kept for the next array of values.
//!
//! A page of values is 128 KiB: above the size at which allocators take memory from the system and give it back with
//! every page. An operator that steps into a second buffer would have each of its pages cleared by the system and mapped anew, which
//! costs more than a step of the first order.

use std::fmt::Debug;
use std::sync::{Arc, Mutex};

use super::leaf::{LeafMask, LeafValues};

/// Most pages that are kept: 256 MiB, the values of some 25 million active voxels.
const MOST_PAGES: usize = 2048;

static VALUES: Mutex<Vec<Arc<[LeafValues]>>> = Mutex::new(Vec::new());

/// What pages are made of.
pub trait Pooled: Clone + Send + Sync + Debug + 'static {
    /// A page that nobody else holds, its entries of any value; `None` if there is none, or none are kept of this kind.
    fn used_page() -> Option<Arc<[Self]>> {
        None
    }

    /// Keeps a page for later if nobody else holds it.
    fn keep_page(_: Arc<[Self]>) {}
}

impl Pooled for LeafValues {
    fn used_page() -> Option<Arc<[Self]>> {
        VALUES.lock().ok()?.pop()
    }

    fn keep_page(mut page: Arc<[Self]>) {
        if Arc::get_mut(&mut page).is_some()
            && let Ok(mut pages) = VALUES.lock()
            && pages.len() < MOST_PAGES
        {
            pages.push(page);
        }
    }
}

/// Pages of masks are small enough for the allocator.
impl Pooled for LeafMask {}
