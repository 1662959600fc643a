use std::path::{Path, PathBuf};

use super::super::{CaptureView, joined};
use crate::{Distortion, Error, Intrinsics, Result, file::write_atomic, quaternion_from_matrix};

/// First line of files that may be replaced.
const MADE_BY: &str = "# generator: zipsplat\n";

/// Returns the paths of a folder's `cameras.txt`, `images.txt` and `points3D.txt`.
pub fn colmap_files(folder: impl AsRef<Path>) -> [PathBuf; 3] {
    ["cameras.txt", "images.txt", "points3D.txt"].map(|name| folder.as_ref().join(name))
}

/// Checks that COLMAP's text can hold the name of a photo.
///
/// # Errors
/// [`Error::Argument`] for an empty one or spaces.
pub fn check_colmap_name(name: &str) -> Result<()> {
    if name.is_empty() || name.contains(char::is_whitespace) {
        return Err(Error::argument("name of a photo for COLMAP", format!("{name:?}"), "one without spaces"));
    }
    Ok(())
}

/// Writes a COLMAP text model to [`colmap_files`] of an existing folder. Frames share equal lenses.
/// Points have no tracks, images no 2D points.
///
/// # Errors
/// [`Error::Argument`] for a name with spaces, a lens without a COLMAP model, or views of a wide
/// lens that moved apart.
pub fn write_colmap(folder: impl AsRef<Path>, frames: &[CaptureView], points: &[([f32; 3], [u8; 3])]) -> Result<()> {
    let mut lenses: Vec<String> = Vec::new();
    let mut images = format!("{MADE_BY}# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of its points\n");
    for (i, (frame, view)) in joined(frames).iter().enumerate() {
        frame.camera.validate(&format!("camera {i}"))?;
        if let Some(view) = view {
            let expected = "all of its views as they were cut; a transforms.json has others";
            return Err(Error::argument(
                format!("lens of {} for COLMAP", frame.name),
                format!("view {view}"),
                expected,
            ));
        }
        check_colmap_name(&frame.name)?;
        let lens = camera(frame)?;
        let place = lenses.iter().position(|other| *other == lens).unwrap_or(lenses.len());
        lenses.extend((place == lenses.len()).then_some(lens));
        let to_camera = frame.camera.pose.inverse();
        let ([w, x, y, z], t) = (quaternion_from_matrix(&to_camera.rotation), to_camera.translation);
        let pose = format!("{w} {x} {y} {z} {} {} {}", t.x, t.y, t.z);
        images += &format!("{} {pose} {} {}\n\n", i + 1, place + 1, frame.name);
    }
    let mut cameras = format!("{MADE_BY}# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n");
    lenses.iter().enumerate().for_each(|(i, lens)| cameras += &format!("{} {lens}\n", i + 1));
    let mut cloud = format!("{MADE_BY}# POINT3D_ID X Y Z R G B ERROR TRACK\n");
    for (i, ([x, y, z], [r, g, b])) in points.iter().enumerate() {
        cloud += &format!("{} {x} {y} {z} {r} {g} {b} 0\n", i + 1);
    }
    for (file, text) in colmap_files(folder).iter().zip([cameras, images, cloud]) {
        write_atomic(file, |out| out.write_all(text.as_bytes()))?;
    }
    Ok(())
}

fn camera(frame: &CaptureView) -> Result<String> {
    let Intrinsics { width, height, fx, fy, cx, cy } =
        frame.lens.map_or(frame.camera.intrinsics, |lens| lens.intrinsics);
    let (model, coefficients) = match frame.lens.map(|lens| lens.distortion) {
        None => ("PINHOLE", Vec::new()),
        Some(Distortion::Equirectangular) => return Ok(format!("EQUIRECTANGULAR {width} {height} {width} {height}")),
        Some(Distortion::Fisheye(k)) => ("OPENCV_FISHEYE", k.to_vec()),
        Some(Distortion::Perspective { numerator: [k1, k2, k3, above], denominator, tangential: [p1, p2] }) => {
            if above != 0.0 {
                let found = format!("a coefficient of r^8, {above}");
                return Err(Error::argument(format!("lens of {}", frame.name), found, "none, as COLMAP's models have"));
            }
            let [k4, k5, k6] = denominator;
            let all = vec![k1, k2, p1, p2, k3, k4, k5, k6];
            let few = all[4..].iter().all(|k| *k == 0.0);
            if few { ("OPENCV", all[..4].to_vec()) } else { ("FULL_OPENCV", all) }
        }
    };
    let parameters = [vec![fx, fy, cx, cy], coefficients].concat();
    Ok(parameters.iter().fold(format!("{model} {width} {height}"), |line, value| line + &format!(" {value}")))
}
