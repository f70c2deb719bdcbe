//! Tracking allocates nothing that grows with the grid once it runs.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

use glam::{DVec3, IVec3};
use vdb_edit::LevelSet;
use vdb_edit::grid::Transform;
use vdb_edit::pde::{SolverOptions, Tracker};
use vdb_edit::run::RunOptions;

/// The system's allocator, counting bytes.
struct Counting;

static BYTES: AtomicU64 = AtomicU64::new(0);

// SAFETY: every call is handed to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        BYTES.fetch_add(layout.size() as u64, Ordering::Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn a_track_allocates_a_small_part_of_the_grid() {
    let run = RunOptions::default();
    let radius = 60.0;
    let bounds = (IVec3::splat(-66), IVec3::splat(66));
    let mut ball =
        LevelSet::from_distance(Transform::uniform(1.0), 3.0, bounds, |p: DVec3| p.length() - radius, &run).unwrap();
    let grid = ball.grid().bytes();
    let mut tracker = Tracker::new(&mut ball, None, SolverOptions::OPENVDB, &run);
    for _ in 0..3 {
        tracker.track().unwrap();
    }
    const TRACKS: u64 = 10;
    let before = BYTES.load(Ordering::Relaxed);
    for _ in 0..TRACKS {
        tracker.track().unwrap();
    }
    let each = (BYTES.load(Ordering::Relaxed) - before) / TRACKS;
    // Lists by page, masks copied while they are read, leaves that come and go at the rim; no buffer of values (more than 90 % of the grid).
    assert!(each < grid / 8, "{each} bytes a track, {grid} in the grid");
}
