//! Edits of scenes: selection, placement, reduction and order of Gaussians.

mod decimate;
mod selection;

use glam::{DMat3, DQuat, DVec3, EulerRot};

use super::{Camera, Pose, Scene, trajectory::mean_up};
use crate::{Error, Result};
use selection::select;

/// An operation of [`Scene::edit`]. Lengths are in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Edit {
    /// Keeps centers between two corners of a box.
    CropBox([DVec3; 2]),
    /// Keeps centers within a radius of a point.
    CropSphere(DVec3, f64),
    /// Moves the scene.
    Translate(DVec3),
    /// Rotates about the origin: degrees about x, y, z in order.
    Rotate(DVec3),
    /// Scales about the origin.
    Scale(f64),
    /// Rotates about the origin: the cameras' mean up becomes -y.
    Level,
    /// Keeps opacities of at least this.
    MinOpacity(f64),
    /// Keeps Gaussians whose largest standard deviation is at most this.
    MaxSize(f64),
    /// Keeps Gaussians with at least this many others within a radius.
    MinNeighbors(usize, f64),
    /// Keeps centers inside at least this many cameras' pictures, regardless of occlusion.
    MinViews(usize),
    /// Drops floaters: opacities below 0.01; Gaussians without another center within 8 times their
    /// largest standard deviation; with cameras also centers outside all doubled pictures.
    Clean,
    /// Lowers the degree of spherical harmonics.
    ShDegree(u32),
    /// Merges similar neighbors until this many Gaussians are left; below 1, this fraction.
    Decimate(f64),
    /// Sorts by opacity times the two largest scales, largest first.
    Sort,
}

/// Effect of an edit.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct EditReport {
    /// Name of the edit.
    pub edit: &'static str,
    /// Number of Gaussians before.
    pub before: usize,
    /// Number of Gaussians after.
    pub after: usize,
    /// Removed Gaussians by reason, or the change of the others.
    pub effect: String,
}

/// A scene after edits.
#[derive(Clone, Debug)]
pub struct Edited {
    /// The scene.
    pub scene: Scene,
    /// Index of each Gaussian before the edits; of several merged, the most visible.
    pub sources: Vec<usize>,
    /// Effects of the edits, in order.
    pub reports: Vec<EditReport>,
}

impl Edit {
    /// Name and numbers of each variant for [`Edit::new`], in order.
    pub const FORMS: [(&str, &str); 14] = [
        ("crop-box", "X,Y,Z,X,Y,Z"),
        ("crop-sphere", "X,Y,Z,RADIUS"),
        ("translate", "X,Y,Z"),
        ("rotate", "X,Y,Z"),
        ("scale", "FACTOR"),
        ("level", ""),
        ("min-opacity", "OPACITY"),
        ("max-size", "LENGTH"),
        ("min-neighbors", "N,RADIUS"),
        ("min-views", "N"),
        ("clean", ""),
        ("sh-degree", "DEGREE"),
        ("decimate", "N|FRACTION"),
        ("sort", ""),
    ];

    /// Creates an edit from its name and its variant's numbers, in order.
    ///
    /// # Errors
    /// [`Error::Argument`] for an unknown name, a wrong count of numbers or an invalid one.
    pub fn new(name: &str, numbers: &[f64]) -> Result<Self> {
        let Some((_, form)) = Self::FORMS.iter().find(|form| form.0 == name) else {
            return Err(Error::argument("edit", name, Self::FORMS.map(|form| form.0).join(", ")));
        };
        let count = |n: f64| (n >= 1.0 && n.fract() == 0.0).then_some(n as usize);
        let edit = match (name, numbers) {
            _ if !numbers.iter().all(|number| number.is_finite()) => None,
            ("crop-box", &[a, b, c, x, y, z]) if a <= x && b <= y && c <= z => {
                Some(Self::CropBox([DVec3::new(a, b, c), DVec3::new(x, y, z)]))
            }
            ("crop-sphere", &[x, y, z, radius]) if radius > 0.0 => Some(Self::CropSphere(DVec3::new(x, y, z), radius)),
            ("translate", &[x, y, z]) => Some(Self::Translate(DVec3::new(x, y, z))),
            ("rotate", &[x, y, z]) => Some(Self::Rotate(DVec3::new(x, y, z))),
            ("scale", &[factor]) if factor > 0.0 => Some(Self::Scale(factor)),
            ("level", []) => Some(Self::Level),
            ("min-opacity", &[least]) if (0.0..=1.0).contains(&least) => Some(Self::MinOpacity(least)),
            ("max-size", &[most]) if most > 0.0 => Some(Self::MaxSize(most)),
            ("min-neighbors", &[n, radius]) if radius > 0.0 => count(n).map(|n| Self::MinNeighbors(n, radius)),
            ("min-views", &[n]) => count(n).map(Self::MinViews),
            ("clean", []) => Some(Self::Clean),
            ("sh-degree", &[0.0]) => Some(Self::ShDegree(0)),
            ("sh-degree", &[degree]) => count(degree)
                .filter(|d| *d <= Scene::MAX_SH_DEGREE as usize)
                .map(|degree| Self::ShDegree(degree as u32)),
            ("decimate", &[n]) if n > 0.0 && (n < 1.0 || n.fract() == 0.0) => Some(Self::Decimate(n)),
            ("sort", []) => Some(Self::Sort),
            _ => None,
        };
        edit.ok_or_else(|| {
            let found = numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(",");
            let expected = match name {
                "crop-box" => "the lower and the upper corner".into(),
                "decimate" => "a number of Gaussians, or a fraction below 1".into(),
                "sh-degree" => format!("0 to {}", Scene::MAX_SH_DEGREE),
                "min-opacity" => "0 to 1".into(),
                _ if form.is_empty() => "no numbers".into(),
                "translate" | "rotate" => "finite numbers".into(),
                _ => "numbers above 0, of Gaussians and cameras whole ones".into(),
            };
            let found = if found.is_empty() { "nothing".into() } else { found };
            Error::argument(name, found, format!("{form}{}{expected}", if form.is_empty() { "" } else { ": " }))
        })
    }

    /// Returns the name.
    pub fn name(&self) -> &'static str {
        let at = match self {
            Self::CropBox(..) => 0,
            Self::CropSphere(..) => 1,
            Self::Translate(..) => 2,
            Self::Rotate(..) => 3,
            Self::Scale(..) => 4,
            Self::Level => 5,
            Self::MinOpacity(..) => 6,
            Self::MaxSize(..) => 7,
            Self::MinNeighbors(..) => 8,
            Self::MinViews(..) => 9,
            Self::Clean => 10,
            Self::ShDegree(..) => 11,
            Self::Decimate(..) => 12,
            Self::Sort => 13,
        };
        Self::FORMS[at].0
    }

    /// Returns true if the edit changes the scene's world.
    pub fn moves(&self) -> bool {
        matches!(self, Self::Translate(..) | Self::Rotate(..) | Self::Scale(..) | Self::Level)
    }

    /// Returns true if the edit needs cameras.
    pub fn needs_cameras(&self) -> bool {
        matches!(self, Self::Level | Self::MinViews(..))
    }

    fn placement(&self, cameras: &[Camera]) -> Result<Option<(f64, Pose)>> {
        let pose = match *self {
            Self::Translate(translation) => Pose { translation, ..Pose::IDENTITY },
            Self::Rotate(degrees) => {
                let [x, y, z] = degrees.to_array().map(f64::to_radians);
                Pose { rotation: DMat3::from_euler(EulerRot::ZYX, z, y, x), ..Pose::IDENTITY }
            }
            Self::Level => {
                let turn = DQuat::from_rotation_arc(mean_up(cameras)?, DVec3::NEG_Y);
                Pose { rotation: DMat3::from_quat(turn), ..Pose::IDENTITY }
            }
            Self::Scale(factor) => return Ok(Some((factor, Pose::IDENTITY))),
            _ => return Ok(None),
        };
        Ok(Some((1.0, pose)))
    }
}

impl Scene {
    /// Returns the `members` that `seeds` reach by steps to one of the nearest `neighbors` centers,
    /// in order.
    ///
    /// # Panics
    /// If `members` are not as many as the Gaussians, or a seed is out of range.
    pub fn connected(&self, members: &[bool], seeds: &[usize], neighbors: usize) -> Vec<usize> {
        selection::connected(self, members, seeds, neighbors)
    }

    /// Returns a copy after `edits`. `cameras` are in the scene's world and move with it.
    ///
    /// # Errors
    /// [`Error::Argument`] for a scene that is invalid before or after, an edit that needs cameras
    /// without any, or one that leaves no Gaussian.
    pub fn edit(&self, edits: &[Edit], cameras: &[Camera]) -> Result<Edited> {
        self.validate()?;
        if let Some(edit) = edits.iter().find(|edit| edit.needs_cameras() && cameras.is_empty()) {
            return Err(Error::argument(edit.name(), "no cameras", "one or more cameras in the scene's world"));
        }
        let sources = (0..self.len()).collect();
        let (mut edited, mut cameras) =
            (Edited { scene: self.clone(), sources, reports: Vec::new() }, cameras.to_vec());
        for edit in edits {
            let before = edited.scene.len();
            let effect = edited.apply(edit, &mut cameras)?;
            if edited.scene.is_empty() && before > 0 {
                let found = format!("no Gaussian of {before} left: {effect}");
                return Err(Error::argument(edit.name(), found, "one or more"));
            }
            edited.reports.push(EditReport { edit: edit.name(), before, after: edited.scene.len(), effect });
        }
        edited.scene.validate()?;
        Ok(edited)
    }

    fn lower_degree(&mut self, degree: u32) {
        if degree < self.sh_degree {
            let (own, kept) = (self.sh_coeffs_per_gaussian(), (degree as usize + 1).pow(2));
            self.sh_coeffs = self.sh_coeffs.chunks_exact(own).flat_map(|coeffs| &coeffs[..kept]).copied().collect();
            self.sh_degree = degree;
        }
    }
}

impl Edited {
    fn keep(&mut self, kept: &[usize]) {
        self.scene.keep(kept);
        self.sources = kept.iter().map(|i| self.sources[*i]).collect();
    }

    fn apply(&mut self, edit: &Edit, cameras: &mut [Camera]) -> Result<String> {
        if let Some((scale, pose)) = edit.placement(cameras)? {
            self.scene.place(scale, &pose);
            cameras.iter_mut().for_each(|camera| *camera = camera.placed(scale, &pose));
            return Ok("moved".into());
        }
        let dropped = match *edit {
            Edit::CropBox([low, high]) => {
                select(self, |_, at| at.cmpge(low).all() && at.cmple(high).all(), "outside the box")
            }
            Edit::CropSphere(center, radius) => {
                select(self, |_, at| at.distance_squared(center) <= radius * radius, "outside the sphere")
            }
            Edit::MinOpacity(least) => selection::opacity(self, least),
            Edit::MaxSize(most) => selection::size(self, most),
            Edit::MinNeighbors(count, radius) => selection::neighbors(self, count, radius),
            Edit::MinViews(count) => selection::views(self, cameras, count),
            Edit::Clean => selection::clean(self, cameras),
            Edit::ShDegree(degree) => {
                let from = self.scene.sh_degree;
                self.scene.lower_degree(degree);
                format!("degree {from} to {}", self.scene.sh_degree)
            }
            Edit::Decimate(count) => {
                let whole = if count < 1.0 { (count * self.scene.len() as f64).round() } else { count };
                decimate::decimate(self, (whole as usize).max(1))
            }
            Edit::Sort => {
                let visibility = self.scene.visibilities();
                let mut order: Vec<usize> = (0..self.scene.len()).collect();
                order.sort_by(|a, b| visibility[*b].total_cmp(&visibility[*a]));
                self.keep(&order);
                "most visible first".into()
            }
            Edit::Translate(_) | Edit::Rotate(_) | Edit::Scale(_) | Edit::Level => unreachable!("a placement"),
        };
        Ok(dropped)
    }
}
