use super::{Indices, Protocol};
use crate::capture::{Choice, farthest_points};
use std::path::Path;
use zipsplat::{Error, Result, types::poses::Capture};

/// Column of the tables.
pub struct Setting {
    pub views: usize,
    rule: Rule,
}

enum Rule {
    /// Frames of an index file.
    Given(Indices),
    /// Farthest-point sampling of the first frames, or all.
    Farthest(Option<usize>),
    /// Evenly from first to last, as in RealEstate10K's reference.
    Even,
}

impl Protocol {
    /// `gaps` override the paper's, one per number of views or one for all.
    pub fn settings(self, views: &[u32], gaps: &[usize], files: &[impl AsRef<Path>]) -> Result<Vec<Setting>> {
        if !files.is_empty() {
            let setting = |file: &_| {
                let indices = Indices::open(AsRef::<Path>::as_ref(file))?;
                Ok(Setting { views: indices.views(), rule: Rule::Given(indices) })
            };
            return files.iter().map(setting).collect();
        }
        let views = if views.is_empty() { self.views() } else { views };
        if gaps.len() > 1 && gaps.len() != views.len() {
            let expected = format!("one, or one for each of {} numbers of --views", views.len());
            return Err(Error::argument("--frame-range", format!("{} numbers", gaps.len()), expected));
        }
        let rule = |i: usize, views: u32| match gaps.get(i).or(gaps.first()).copied().or(self.gap(views)) {
            None if self == Self::Re10k => Rule::Even,
            gap => Rule::Farthest(gap),
        };
        Ok(views.iter().enumerate().map(|(i, n)| Setting { views: *n as usize, rule: rule(i, *n) }).collect())
    }
}

impl Setting {
    /// Such as `6v`.
    pub fn name(&self) -> String {
        format!("{}v", self.views)
    }

    pub fn rule(&self) -> String {
        match &self.rule {
            Rule::Given(indices) => format!("indices-{}", indices.digest),
            Rule::Farthest(Some(gap)) => format!("gap{gap}"),
            Rule::Farthest(None) => "all".into(),
            Rule::Even => "even".into(),
        }
    }

    pub fn choose(&self, scene: &str, poses: Capture, targets: usize) -> Result<Option<Choice>> {
        let found: Vec<usize> = (0..poses.frames.len()).filter(|i| poses.frames[*i].photo.is_some()).collect();
        let gap = match &self.rule {
            Rule::Given(indices) => {
                let Some(entry) = indices.of(scene) else { return Ok(None) };
                if let Some(place) = poses.sizeless.first() {
                    let expected = "the photo of every frame, since --indices counts frames";
                    return Err(Error::argument(format!("photo of {scene}"), place.display(), expected));
                }
                return Choice::given(poses, scene, entry.context.clone(), entry.target.clone()).map(Some);
            }
            Rule::Farthest(gap) => gap.unwrap_or(found.len()).min(found.len()),
            Rule::Even => found.len(),
        };
        if gap <= self.views {
            let expected = format!("more than the {} that are given, to have some to compare with", self.views);
            return Err(Error::argument(format!("frames of {scene}"), gap, expected));
        }
        let window = &found[..gap];
        let inputs: Vec<usize> = match self.rule {
            Rule::Even => even(window, self.views),
            _ => {
                let centers: Vec<_> = window.iter().map(|i| poses.frames[*i].camera.pose.translation).collect();
                farthest_points(&centers, self.views).into_iter().map(|i| window[i]).collect()
            }
        };
        let targets = spread(window, &inputs, targets);
        Choice::given(poses, scene, inputs, targets).map(Some)
    }
}

/// Equal steps from the first, as in DL3DV's reference.
fn spread(window: &[usize], inputs: &[usize], count: usize) -> Vec<usize> {
    let others: Vec<usize> = window.iter().copied().filter(|i| !inputs.contains(i)).collect();
    let step = (others.len() / count).max(1);
    others.into_iter().step_by(step).take(count).collect()
}

/// First to last, rounded down, as in RealEstate10K's reference.
fn even(window: &[usize], count: usize) -> Vec<usize> {
    (0..count).map(|i| window[i * (window.len() - 1) / (count - 1).max(1)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use zipsplat::types::{Camera, Intrinsics, Pose, poses::CaptureView};

    /// From the reference's files for DL3DV with 6 inputs and for RealEstate10K.
    #[test]
    fn frames_are_those_of_the_reference() {
        let frames: Vec<usize> = (0..279).collect();
        let inputs = [0, 19, 29, 33, 39, 49];
        assert_eq!(spread(&frames[..50], &inputs, 8), [1, 6, 11, 16, 22, 27, 34, 40]);
        assert_eq!(even(&frames, 6), [0, 55, 111, 166, 222, 278]);
    }

    /// Frames on a line with doubling steps; the third has no photo.
    fn line(count: i32) -> Capture {
        let frame = |i: i32| CaptureView {
            name: i.to_string(),
            photo: (i != 2).then(|| i.to_string().into()),
            camera: Camera {
                intrinsics: Intrinsics::from_fov(8, 8, 1.0, 1.0),
                pose: Pose { translation: DVec3::X * 2f64.powi(i), ..Pose::IDENTITY },
            },
            lens: None,
        };
        Capture { frames: (0..count).map(frame).collect(), ..Capture::default() }
    }

    fn chosen(protocol: Protocol, views: &[u32], gaps: &[usize]) -> Vec<String> {
        let none: [&Path; 0] = [];
        let settings = protocol.settings(views, gaps, &none).expect("settings");
        let choice = settings[0].choose("line", line(12), 2).expect("enough frames").expect("frames");
        choice.frames().map(|frame| frame.name.clone()).collect()
    }

    #[test]
    fn inputs_are_taken_from_the_first_frames() {
        assert_eq!(chosen(Protocol::Dl3dv, &[3], &[6]), ["0", "5", "6", "1", "3"]);
        assert_eq!(chosen(Protocol::Mipnerf360, &[3], &[]), ["0", "10", "11", "1", "6"]);
        assert_eq!(chosen(Protocol::Re10k, &[3], &[]), ["0", "6", "11", "1", "7"]);
        assert_eq!(chosen(Protocol::Re10k, &[3], &[6]), ["0", "5", "6", "1", "3"]);
    }

    #[test]
    fn settings_are_those_of_the_paper() {
        let none: [&Path; 0] = [];
        let names = |protocol: Protocol, views: &[u32]| -> Vec<String> {
            let settings = protocol.settings(views, &[], &none).expect("settings");
            settings.iter().map(|setting| format!("{} {}", setting.name(), setting.rule())).collect()
        };
        assert_eq!(names(Protocol::Dl3dv, &[]), ["6v gap50", "12v gap100", "24v gap150"]);
        assert_eq!(names(Protocol::Dl3dv, &[8]), ["8v all"]);
        assert_eq!(names(Protocol::Re10k, &[]), ["6v even"]);
        assert_eq!(names(Protocol::Scannetpp, &[]), ["32v all", "64v all", "128v all"]);
        assert!(Protocol::Dl3dv.settings(&[6, 12, 24], &[50, 100], &none).is_err());
        let few = Protocol::Dl3dv.settings(&[6], &[6], &none).expect("settings");
        assert!(few[0].choose("line", line(12), 8).is_err(), "nothing is left to compare with");
    }
}
