use clap::ValueEnum;
use std::ops::ControlFlow;
use zipsplat::{
    Error, Result,
    refine::{Photos, stereo_points},
    types::{Camera, PointCloud, Scene},
};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Initialization {
    /// A Gaussian at each point of the capture, and where stereo between photos finds surfaces
    Points,
    /// The scene's Gaussians
    Scene,
    /// Both together
    Both,
}

/// Minimum points to prefer over the built-in model's scene.
const ENOUGH: usize = 500;

impl Initialization {
    /// Points only for the built-in model, if there are enough.
    pub fn or_best(asked: Option<Self>, cloud: Option<&PointCloud>, embedded: bool) -> Self {
        let enough = embedded && cloud.is_some_and(|cloud| cloud.positions.len() >= ENOUGH);
        asked.unwrap_or(if enough { Self::Points } else { Self::Scene })
    }

    /// A scene, and points.
    pub fn needs(self) -> [bool; 2] {
        [self != Self::Points, self != Self::Scene]
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Points => "the capture's points",
            Self::Scene => "the scene",
            Self::Both => "the scene and the capture's points",
        }
    }

    /// An unneeded scene or cloud may be `None`. Stereo adds points up to `most`.
    pub fn scene(
        self,
        scene: Option<Scene>,
        cloud: Option<&PointCloud>,
        photos: &dyn Photos,
        cameras: &[Camera],
        most: Option<usize>,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Scene> {
        let lacks = |found: &str, expected: &str| Error::argument("start of the refinement", found, expected);
        let of_scene = || scene.ok_or_else(|| lacks("no scene", "a scene, or --init points"));
        let of_points = || {
            let expected =
                "ply_file_path of transforms.json, points.ply beside it, or COLMAP's points3D; or --init scene";
            let cloud = cloud.ok_or_else(|| lacks("no point cloud", expected))?;
            Scene::from_points(&stereo_points(photos, cameras, cloud, most, progress)?, cameras)
        };
        match self {
            Self::Scene => of_scene(),
            Self::Points => of_points(),
            Self::Both => {
                let scene = of_scene()?;
                let points = Scene { antialiased: scene.antialiased, ..of_points()? };
                Scene::concat(scene, points)
            }
        }
    }
}
