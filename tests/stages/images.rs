use image::{DynamicImage, ImageFormat};
use zipsplat::types::poses::CaptureView;
use zipsplat::types::preprocess::{DEFAULT_SIZE, View, crop_to_aspect, fit};
use zipsplat::types::resample::resize_lanczos;
use zipsplat::types::{World, check_jpeg_end, contact_sheet, tile_count, tiles};
use zipsplat_cli::protocol::Filter;
use zipsplat_tests::photos::with_orientation;
use zipsplat_tests::prelude::*;

fn chw_to_hwc<T: Copy>(chw: &[T]) -> Vec<T> {
    let plane = chw.len() / 3;
    (0..plane).flat_map(|i| [chw[i], chw[plane + i], chw[2 * plane + i]]).collect()
}

fn noise(width: u32, height: u32) -> Image {
    let byte = |i: u32| (i.wrapping_mul(2_654_435_761) >> 24) as u8;
    Image::new(width, height, (0..3 * width * height).map(byte).collect()).unwrap()
}

fn dynamic(image: &Image) -> DynamicImage {
    DynamicImage::ImageRgb8(image::RgbImage::from_vec(image.width, image.height, image.rgb.clone()).unwrap())
}

fn open(bytes: &[u8]) -> Result<Image, Error> {
    let opened = read_as("photo", bytes, |path| Image::open(path));
    if let Err(error) = &opened {
        assert!(error.to_string().contains("photo"), "{error} does not name the file");
    }
    opened
}

#[track_caller]
fn assert_format_error(bytes: &[u8], reason: &str) {
    assert_malformed("photo", bytes, |path| Image::open(path), &[reason]);
}

#[test]
fn lanczos_is_pillows_bit_for_bit() {
    for name in ["pre_up_120x97", "pre_gradient_640x427"] {
        let photo = Image::open(golden::find(&format!("{name}.png")).unwrap()).unwrap();
        let truth = Image::open(golden::find(&format!("{name}.to_square.png")).unwrap()).unwrap();
        let View { image, .. } = fit(&photo, DEFAULT_SIZE, DEFAULT_SIZE).unwrap();
        assert_same(name, &image.rgb, &truth.rgb);
    }
}

#[test]
fn preprocessing_matches_every_golden() {
    let Some(truth) = Golden::open("preproc.safetensors") else { return };
    for name in truth.stems("/to_square_u8") {
        let photo = Image::open(golden::find(&format!("pre_{name}.png")).unwrap()).unwrap();
        let square = fit(&photo, DEFAULT_SIZE, DEFAULT_SIZE).unwrap().image;
        assert_same(&name, &square.rgb, &chw_to_hwc(&truth.u8(&format!("{name}/to_square_u8"))));
    }
    for row in truth.f64("crop_to_ar_cases@f64").chunks(11) {
        let rect = crop_to_aspect(row[1] as u32, row[0] as u32, row[2]);
        let found = [rect.top, rect.left, rect.height, rect.width].map(f64::from);
        assert_eq!(found, row[3..7], "{row:?}");
    }
}

/// Summation order flips some values by one (FORMAT.md, 6).
#[test]
fn bilinear_matches_every_golden() {
    let Some(truth) = Golden::open("preproc.safetensors") else { return };
    for name in truth.stems("/splatfactory_u8") {
        let photo = Image::open(golden::find(&format!("pre_{name}.png")).unwrap()).unwrap();
        let View { image, map } = Filter::Bilinear.cropped(&photo, DEFAULT_SIZE, DEFAULT_SIZE).unwrap();
        let expected = chw_to_hwc(&truth.u8(&format!("{name}/splatfactory_u8")));
        let apart = image.rgb.iter().zip(&expected).map(|(a, b)| a.abs_diff(*b));
        let (most, flips) = (apart.clone().max().unwrap(), apart.map(u64::from).sum::<u64>());
        assert!(most <= 1 && flips * 100 < expected.len() as u64, "{name}: {most} at most, {flips} in all");
        let transform = truth.f64(&format!("{name}/splatfactory_transform@f64"));
        let found = [map.scale[0], map.offset[0], map.scale[1], map.offset[1]];
        for (found, expected) in found.into_iter().zip([transform[0], transform[2], transform[4], transform[5]]) {
            assert!((found - expected).abs() < 1e-12, "{name}: {found}, expected {expected}");
        }
    }
}

#[test]
fn bilinear_is_that_of_f64() {
    let photo = noise(38, 27);
    let image = Filter::Bilinear.whole(&photo, 12, 8).unwrap().image;
    assert_eq!((image.width, image.height), (12, 8));
    let weights = |from: u32, to: u32, i: u32| -> Vec<f64> {
        let scale = f64::from(from) / f64::from(to);
        let center = (f64::from(i) + 0.5) * scale;
        let weights = (0..from).map(|j| (1.0 - (f64::from(j) + 0.5 - center).abs() / scale).max(0.0));
        let total: f64 = weights.clone().sum();
        weights.map(|weight| weight / total).collect()
    };
    for (x, y, c) in (0..12).flat_map(|x| (0..8).flat_map(move |y| (0..3).map(move |c| (x, y, c)))) {
        let (across, down) = (weights(38, 12, x), weights(27, 8, y));
        let value = |(i, j): (usize, usize)| across[i] * down[j] * f64::from(photo.rgb[3 * (j * 38 + i) + c]);
        let expected: f64 = (0..38).flat_map(|i| (0..27).map(move |j| (i, j))).map(value).sum();
        let found = f64::from(image.rgb[3 * (y * 12 + x) as usize + c]);
        assert!((found - expected + 0.5).abs() < 0.51, "{x} {y} {c}: {found}, expected {expected} rounded down");
    }
}

#[test]
fn a_pass_whose_size_matches_changes_nothing() {
    let photo = noise(60, 40);
    assert_eq!(resize_lanczos(&photo, 60, 40).unwrap(), photo);
    // Columns are filtered independently.
    let column = photo.crop(7, 0, 1, 40).unwrap();
    let (all, one) = (resize_lanczos(&photo, 60, 25).unwrap(), resize_lanczos(&column, 1, 25).unwrap());
    assert_eq!(all.crop(7, 0, 1, 25).unwrap(), one);
}

#[test]
fn rectangular_views_keep_the_aspect_ratio_and_their_intrinsics() {
    let photo = noise(640, 427);
    for (width, height) in [(336, 252), (140, 280), (14, 14), (518, 518)] {
        let view = fit(&photo, width, height).unwrap();
        assert_eq!((view.image.width, view.image.height), (width, height));
        let lens = Intrinsics { width: 640, height: 427, fx: 500.0, fy: 510.0, cx: 320.0, cy: 213.5 };
        let mapped = view.map.apply(&lens, "lens").unwrap();
        // Up to half a pixel for odd crops.
        let scale = view.map.scale[0].max(view.map.scale[1]);
        assert!((mapped.cx - f64::from(width) / 2.0).abs() <= 0.5 * scale.max(1.0) + 1e-9, "{mapped:?}");
        assert!((mapped.cy - f64::from(height) / 2.0).abs() <= 0.5 * scale.max(1.0) + 1e-9, "{mapped:?}");
        let uneven = mapped.fx / mapped.fy * lens.fy / lens.fx;
        assert!((uneven - 1.0).abs() < 0.05, "{uneven}");
        // At half the resolution.
        let half = Intrinsics { width: 320, height: 214, fx: 250.0, fy: 255.0 * 428.0 / 427.0, cx: 160.0, cy: 107.0 };
        let from_half = view.map.apply(&half, "half").unwrap();
        assert!((from_half.fx - mapped.fx).abs() < 1e-9 && (from_half.cy - mapped.cy).abs() < 1e-9);
    }
    let turned = Intrinsics { width: 427, height: 640, fx: 500.0, fy: 500.0, cx: 213.5, cy: 320.0 };
    let view = fit(&photo, 252, 252).unwrap();
    assert!(matches!(view.map.apply(&turned, "turned"), Err(Error::Argument { .. })));
    for (width, height) in [(0, 252), (252, 0), (250, 252)] {
        assert!(matches!(fit(&photo, width, height), Err(Error::Argument { .. })));
    }
}

fn color(direction: DVec3) -> [f64; 3] {
    let d = direction.normalize();
    [d.x, d.y, d.x * d.y].map(|value| 127.5 + 110.0 * (3.0 * value).sin())
}

#[test]
fn squares_show_what_their_cameras_see() {
    let pose = Pose { rotation: DMat3::from_rotation_y(0.4) * DMat3::from_rotation_x(-0.3), translation: DVec3::ONE };
    for (width, height, count) in [(300, 200, 2), (200, 400, 2), (210, 200, 1), (500, 200, 3)] {
        let intrinsics = Intrinsics {
            width,
            height,
            fx: 210.0,
            fy: 205.0,
            cx: 0.52 * f64::from(width),
            cy: 0.49 * f64::from(height),
        };
        let camera = Camera { intrinsics, pose };
        let ray = |i: &Intrinsics, x: u32, y: u32| {
            DVec3::new((f64::from(x) + 0.5 - i.cx) / i.fx, (f64::from(y) + 0.5 - i.cy) / i.fy, 1.0)
        };
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let rgb = pixels.flat_map(|(x, y)| color(ray(&intrinsics, x, y)).map(|value| value.round() as u8)).collect();
        let photo = Image::new(width, height, rgb).unwrap();
        let views = tiles(&photo, &camera, 56, "camera").unwrap();
        assert_eq!((views.len(), tile_count(width, height)), (count, count));
        let mut seen = vec![false; (width * height) as usize];
        for (image, view) in &views {
            assert_eq!((view.intrinsics.cx, view.intrinsics.cy, view.intrinsics.width), (28.0, 28.0, 56));
            assert!(view.intrinsics.fx == view.intrinsics.fy && view.pose.translation == pose.translation);
            for (x, y) in (0..56).flat_map(|y| (0..56).map(move |x| (x, y))) {
                let d = pose.rotation.transpose() * view.pose.rotation * ray(&view.intrinsics, x, y);
                let at = [intrinsics.fx * d.x / d.z + intrinsics.cx, intrinsics.fy * d.y / d.z + intrinsics.cy];
                let inside = |place: f64, length: u32| (4.0..f64::from(length) - 4.0).contains(&place);
                if inside(at[0], width) && inside(at[1], height) {
                    let pixel = 3 * (y * 56 + x) as usize;
                    let truth = color(d);
                    let apart = (0..3).map(|c| (f64::from(image.rgb[pixel + c]) - truth[c]).abs()).fold(0.0, f64::max);
                    assert!(apart < 4.0, "{apart} levels at ({x}, {y}) of a square of {width}x{height}");
                }
            }
            for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
                let d = view.pose.rotation.transpose() * pose.rotation * ray(&intrinsics, x, y);
                let i = &view.intrinsics;
                let at = [i.fx * d.x / d.z + i.cx, i.fy * d.y / d.z + i.cy];
                seen[(y * width + x) as usize] |= d.z > 0.0 && at.iter().all(|place| (0.0..56.0).contains(place));
            }
        }
        let seen_share = seen.iter().filter(|seen| **seen).count() as f64 / seen.len() as f64;
        assert!(seen_share > 0.95, "{seen_share} of {width}x{height} is seen");
    }
    let (photo, wrong) = (noise(300, 200), Intrinsics::from_fov(200, 300, 1.0, 1.0));
    let refused = tiles(&photo, &Camera { intrinsics: wrong, pose }, 56, "camera 7");
    assert!(matches!(refused, Err(Error::Argument { what, .. }) if what.contains("camera 7")));
}

#[test]
fn extreme_photos_are_cropped_or_refused() {
    let thread = noise(1, 3000);
    assert_eq!(fit(&thread, 252, 252).unwrap().image.rgb.len(), 3 * 252 * 252);
    let broken = Image { width: 10, height: 10, rgb: vec![0; 299], mask: None };
    assert!(matches!(fit(&broken, 14, 14), Err(Error::Argument { .. })));
    assert!(Image::new(0, 5, Vec::new()).is_err());
}

#[test]
fn exif_orientations_are_applied() {
    let (width, height) = (48, 32);
    let jpeg = encoded(&dynamic(&noise(width, height)), ImageFormat::Jpeg);
    let stored = open(&jpeg).unwrap();
    let (right, bottom) = (width - 1, height - 1);
    for orientation in 1..=8u8 {
        let bytes = with_orientation(&jpeg, orientation);
        let upright = open(&bytes).unwrap();
        // EXIF 2.3, tag 0x0112.
        let stored_from_seen = |x: u32, y: u32| match orientation {
            1 => (x, y),
            2 => (right - x, y),
            3 => (right - x, bottom - y),
            4 => (x, bottom - y),
            5 => (y, x),
            6 => (y, bottom - x),
            7 => (right - y, bottom - x),
            _ => (right - y, x),
        };
        let expected_size = if orientation < 5 { (width, height) } else { (height, width) };
        assert_eq!((upright.width, upright.height), expected_size, "orientation {orientation}");
        for (i, pixel) in upright.rgb.chunks(3).enumerate() {
            let (x, y) = stored_from_seen(i as u32 % upright.width, i as u32 / upright.width);
            let at = 3 * (y * width + x) as usize;
            assert_eq!(pixel, &stored.rgb[at..at + 3], "orientation {orientation}, pixel {i}");
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), &bytes).unwrap();
        assert_eq!(Image::size(file.path()).unwrap(), expected_size);
        assert_eq!(Image::open_as_stored(file.path()).unwrap(), stored, "as COLMAP sees it");
        assert_eq!(Image::size_as_stored(file.path()).unwrap(), (width, height));
        let lens = |(width, height)| Intrinsics { width, height, fx: 40.0, fy: 43.0, cx: 21.0, cy: 17.0 };
        let pose = Pose { rotation: DMat3::from_rotation_y(0.4), translation: DVec3::new(1.0, 2.0, 3.0) };
        let seen = Camera { intrinsics: lens(expected_size), pose };
        let turned = Image::camera_as_stored(file.path(), &seen);
        if [2, 4, 5, 7].contains(&orientation) {
            assert_refused(turned, &["EXIF orientation"]);
            continue;
        }
        let turned = turned.expect("a turn");
        turned.validate("the turned camera").expect("a camera");
        assert_eq!((turned.intrinsics.width, turned.intrinsics.height), (width, height));
        let pixel = |camera: &Camera| {
            let (at, lens) = (camera.pose.inverse().transform(DVec3::new(0.8, 2.1, 5.0)), camera.intrinsics);
            [lens.fx * at.x / at.z + lens.cx, lens.fy * at.y / at.z + lens.cy]
        };
        let ([x, y], [u, v], [w, h]) = (pixel(&seen), pixel(&turned), [width, height].map(f64::from));
        let [expected_u, expected_v] = match orientation {
            1 => [x, y],
            3 => [w - x, h - y],
            6 => [y, h - x],
            _ => [w - y, x],
        };
        assert!((u - expected_u).abs() < 1e-9 && (v - expected_v).abs() < 1e-9, "orientation {orientation}: {u}, {v}");
        assert_eq!(stored.clone().turned(Image::quarter_turns(file.path()).expect("a turn")), upright);
        let photo = Some(file.path().to_owned());
        let frame = CaptureView { name: "photo".into(), photo, camera: turned, lens: None };
        let [x, y] = pixel(&frame.upright_camera());
        assert!((pixel(&seen)[0] - x).abs() < 1e-9 && (pixel(&seen)[1] - y).abs() < 1e-9, "orientation {orientation}");
        let foreign = CaptureView { camera: seen, ..frame.clone() };
        assert_eq!(foreign.quarter_turns(), if orientation > 4 { 0 } else { frame.quarter_turns() });
        let up = World::of_cameras(&[&frame]).and_then(|world| world.up).expect("an up");
        assert!(up.distance(-pose.rotation.y_axis) < 1e-9, "orientation {orientation}: {up}");
    }
    assert_eq!(open(&with_orientation(&jpeg, 77)).unwrap(), stored, "an unknown orientation is none");
}

#[test]
fn truncated_photos_are_refused() {
    let photo = dynamic(&noise(200, 150));
    let jpeg = with_orientation(&encoded(&photo, ImageFormat::Jpeg), 1);
    for kept in [jpeg.len() / 2, jpeg.len() * 9 / 10, jpeg.len() - 2] {
        assert_format_error(&jpeg[..kept], "");
        let words = ["truncated: found a JPEG without its end marker", "expected a whole file"];
        assert_malformed("photo", &jpeg[..kept], |path| check_jpeg_end(path), &words);
    }
    assert_format_error(&jpeg[..jpeg.len() * 9 / 10], "truncated");
    let with_trailer = [&jpeg[..], b"a video that the camera put behind the photo"].concat();
    assert_eq!(open(&with_trailer).unwrap(), open(&jpeg).unwrap());
    for whole in [&jpeg, &with_trailer] {
        read_as("photo", whole, |path| check_jpeg_end(path)).expect("an end marker");
    }
    for format in [ImageFormat::Png, ImageFormat::WebP] {
        let bytes = encoded(&photo, format);
        assert_eq!(open(&bytes).unwrap().rgb, photo.as_bytes(), "{format:?} is lossless here");
        assert_format_error(&bytes[..bytes.len() / 2], "");
    }
}

#[test]
fn other_pixel_types_become_rgb8() {
    let alpha = image::RgbaImage::from_vec(2, 1, vec![10, 20, 30, 0, 40, 50, 60, 128]).unwrap();
    for format in [ImageFormat::Png, ImageFormat::WebP] {
        let opened = open(&encoded(&DynamicImage::ImageRgba8(alpha.clone()), format)).unwrap();
        assert_eq!(opened.rgb, [10, 20, 30, 40, 50, 60], "alpha is dropped, not blended");
    }
    let gray = DynamicImage::ImageLuma8(image::GrayImage::from_vec(2, 1, vec![7, 250]).unwrap());
    assert_eq!(open(&encoded(&gray, ImageFormat::Png)).unwrap().rgb, [7, 7, 7, 250, 250, 250]);
    let samples = vec![0x12ff, 0x1280, 0x127f, 0xff00, 0x00ff, 0xffff];
    let deep = DynamicImage::ImageRgb16(image::ImageBuffer::from_vec(2, 1, samples).unwrap());
    assert_eq!(open(&encoded(&deep, ImageFormat::Png)).unwrap().rgb, [0x12, 0x12, 0x12, 0xff, 0, 0xff]);
    let deep = DynamicImage::ImageLuma16(image::ImageBuffer::from_vec(1, 1, vec![0xabff]).unwrap());
    assert_eq!(open(&encoded(&deep, ImageFormat::Png)).unwrap().rgb, [0xab; 3]);
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 })
    })
}

#[test]
fn files_that_are_no_photos_are_refused() {
    assert_format_error(b"", "no PNG");
    assert_format_error(b"a letter, not a photo", "no PNG");
    assert_format_error(b"\x89PNG\r\n\x1a\n", "");
    assert_format_error(&[0xff, 0xd8, 0xff], "");
    let missing = Image::open("no/such/photo.png");
    assert!(matches!(&missing, Err(Error::Io { path, .. }) if path == Path::new("no/such/photo.png")), "{missing:?}");

    for (width, height) in [(100_000u32, 10u32), (32_000, 32_000)] {
        let mut png = encoded(&dynamic(&noise(2, 2)), ImageFormat::Png);
        png[16..20].copy_from_slice(&width.to_be_bytes());
        png[20..24].copy_from_slice(&height.to_be_bytes());
        let checksum = crc32(&png[12..29]);
        png[29..33].copy_from_slice(&checksum.to_be_bytes());
        assert_format_error(&png, "");
    }
}

#[test]
fn pngs_appear_whole_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let names =
        || -> Vec<PathBuf> { fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path()).collect() };
    let (picture, path) = (noise(37, 21), folder.path().join("frame.png"));
    picture.save_png(&path).unwrap();
    assert_eq!(Image::open(&path).unwrap(), picture);
    noise(5, 5).save_png(&path).unwrap();
    assert_eq!(Image::open(&path).unwrap(), noise(5, 5), "an old file is replaced");
    assert_eq!(names(), std::slice::from_ref(&path), "no temporary file is left");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let reference = folder.path().join("plain");
        fs::write(&reference, "").unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&path), mode(&reference), "as readable as any new file");
    }
    let nowhere = folder.path().join("missing/frame.png");
    assert!(matches!(picture.save_png(&nowhere), Err(Error::Io { path, .. }) if path == nowhere));
}

#[test]
fn rendered_frames_are_clamped_and_truncated() {
    let frame = [-1.0, 0.0, 0.999, 1.0, 7.0, f32::NAN, 0.5, 254.999 / 255.0, 1.0 / 255.0];
    assert_eq!(Image::from_rgb_f32(3, 1, &frame).unwrap().rgb, [0, 0, 254, 255, 255, 0, 127, 254, 1]);
    assert!(matches!(Image::from_rgb_f32(2, 1, &frame), Err(Error::Argument { .. })));
}

#[test]
fn contact_sheets_have_a_cell_for_each_picture() {
    let pictures = [noise(4, 2), noise(3, 5), noise(1, 1)];
    let sheet = contact_sheet(&pictures, 2).unwrap();
    assert_eq!((sheet.width, sheet.height), (8, 10));
    for (picture, (left, top)) in pictures.iter().zip([(0, 0), (4, 0), (0, 5)]) {
        assert_eq!(sheet.crop(left, top, picture.width, picture.height).unwrap(), *picture);
    }
    let lit = |image: &Image| image.rgb.iter().filter(|&&value| value > 0).count();
    assert_eq!(lit(&sheet), pictures.iter().map(lit).sum::<usize>(), "the rest is black");
    assert_eq!(contact_sheet(&pictures[..1], 9).unwrap(), pictures[0]);
    assert!(contact_sheet(&[], 2).is_err() && contact_sheet(&pictures, 0).is_err());
}
