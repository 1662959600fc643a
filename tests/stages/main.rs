//! Stages against goldens.

mod weights;
