//! The viewer of scenes: a page for a browser, and the server that hands it out on this machine. The page's own parts are in
//! `tools/viewer`.

mod cameras;
mod page;
mod server;

pub use cameras::{InputCamera, input_cameras, vertical};
pub use page::{Config, Requests, ShownScene, write_page};
pub use server::Server;
