//! Checkpoint -> checked, shaped tensors.
