pub mod activate;
pub mod activate_backward;
