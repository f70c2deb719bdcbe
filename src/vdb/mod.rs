//! .vdb
mod bridge;
