//! Stages against goldens, and the references themselves.

mod references;
mod weights;
