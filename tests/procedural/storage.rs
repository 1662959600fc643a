use crate::stream::{Header, Record};
use crate::{capture, options};
use std::io::ErrorKind;
use zipsplat_cli::procedural::shards::write;
use zipsplat_cli::procedural::{Options, Photos, write_folder};
use zipsplat_tests::prelude::*;

fn stream(seeds: std::ops::Range<u64>, options: &Options) -> Vec<u8> {
    let mut bytes = Vec::new();
    write(&mut bytes, seeds, options, &Photos::default(), |_| ControlFlow::Continue(())).expect("a stream");
    bytes
}

#[test]
fn a_stream_is_read_back() {
    let options = Options { random_first: true, width: 24, ..options(4, 20) };
    let bytes = stream(11..14, &options);
    let mut rest = bytes.as_slice();
    let header = Header::read(&mut rest).expect("a header");
    assert_eq!(header, Header { scenes: 3, views: 4, height: 20, width: 24 });
    assert_eq!(rest.len(), 3 * header.scene_bytes());
    for seed in 11..14 {
        let record = Record::read(&header, &mut rest).expect("a scene");
        let capture = capture(seed, &options);
        assert_eq!((record.seed, record.family, record.path), (seed, capture.family, capture.path));
        assert_eq!(record.colors, capture.images.iter().flat_map(|image| image.rgb.clone()).collect::<Vec<_>>());
        assert_eq!(record.overlap, capture.overlap);
        for (half, depth) in record.depths.iter().zip(capture.depths.iter().flatten()) {
            assert!((half.to_f32() - depth).abs() <= depth / 2048.0, "depth {depth} became {half}");
        }
        for (camera, (pose, intrinsics)) in capture.cameras.iter().zip(record.poses.iter().zip(&record.intrinsics)) {
            let matrix = camera.pose.matrix().transpose().to_cols_array();
            let close = pose.iter().zip(matrix).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6);
            assert!(close, "{pose:?} is not {matrix:?}");
            let i = camera.intrinsics;
            assert_eq!(*intrinsics, [i.fx, i.fy, i.cx, i.cy].map(|value| value as f32));
        }
    }
    assert_eq!(Record::read(&header, &mut rest).expect_err("the end").kind(), ErrorKind::UnexpectedEof);
}

#[test]
fn parts_of_a_stream_are_streams_of_their_scenes() {
    let options = options(2, 16);
    let body = |bytes: Vec<u8>| bytes[36..].to_vec();
    let [whole, first, second] = [0..70, 0..5, 5..70].map(|seeds| body(stream(seeds, &options)));
    assert!(whole == [first, second].concat());
}

#[test]
fn a_stream_stops_when_told() {
    let mut bytes = Vec::new();
    let stop = |_| ControlFlow::Break(());
    let result = write(&mut bytes, 0..u64::MAX, &options(2, 16), &Photos::default(), stop);
    assert_eq!(result.expect_err("it was stopped").kind(), ErrorKind::Interrupted);
    assert_eq!(Header::read(bytes.as_slice()).expect("a header").scenes, 0);
}

#[test]
fn other_streams_are_refused() {
    let mut bytes = stream(0..1, &options(2, 16));
    let header = Header::read(bytes.as_slice()).expect("a header");
    bytes[36 + 8] = 200;
    assert_eq!(Record::read(&header, &bytes[36..]).expect_err("no family").kind(), ErrorKind::InvalidData);
    bytes[0] = b'?';
    assert_eq!(Header::read(bytes.as_slice()).expect_err("no magic").kind(), ErrorKind::InvalidData);
}

#[test]
fn a_folder_is_read_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let capture = capture(3, &Options { width: 30, ..options(3, 20) });
    write_folder(folder.path(), &capture, &[]).expect("a folder that can be written");
    let poses = Capture::open(folder.path()).expect("transforms.json");
    assert_eq!(poses.frames.len(), 3);
    for (i, frame) in poses.frames.iter().enumerate() {
        assert_eq!(Image::open(frame.photo.as_ref().expect("a photo")).expect("a picture"), capture.images[i]);
        let (read, made) = (frame.camera, capture.cameras[i]);
        assert_eq!(read.intrinsics, made.intrinsics);
        assert!(read.pose.rotation.abs_diff_eq(made.pose.rotation, 1e-6));
        assert!(read.pose.translation.abs_diff_eq(made.pose.translation, 1e-9));
        let npy = std::fs::read(folder.path().join(format!("depth/{i:03}.npy"))).expect("depth");
        let (header, values) = npy.split_at(128);
        assert!(header.starts_with(b"\x93NUMPY\x01\x00\x76\x00{") && header.ends_with(b" \n"));
        assert!(String::from_utf8_lossy(header).contains("'descr': '<f4', 'fortran_order': False, 'shape': (20, 30)"));
        assert_eq!(values, capture.depths[i].iter().flat_map(|z| z.to_le_bytes()).collect::<Vec<_>>());
    }
}
