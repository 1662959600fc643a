mod answers;
mod cameras;
mod live;
mod page;
mod photos;
mod pixels;
mod recording;
mod server;
mod watched;

pub use answers::Served;
pub use cameras::{InputCamera, input_cameras, vertical};
pub use live::Live;
pub use page::{Config, Requests, ShownScene, write_page};
pub use photos::{FromPhotos, Ready};
pub use recording::Studio;
pub use server::Server;
pub use watched::Watched;
