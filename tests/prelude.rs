pub use crate::{
    architectures,
    compare::{
        ImageTolerance, Picture, Tolerance, assert_as_near, assert_close, assert_gaussians_close,
        assert_gaussians_within, assert_images_close, assert_nearest, assert_same, assert_tap_within, columns,
    },
    device::device,
    files::{assert_malformed, assert_refused, bytes_of, encoded, gunzip, gzip, read_as},
    golden::{self, Golden},
    networks::{self, fast_arithmetics, reconstruct},
    photos::{self, noise},
    processes::{assert_succeeds, child, target},
    random::{random, random_below},
    reference::widen,
    scenes::{
        self, bits, camera, golden_cameras, golden_scene, packed, random_scene, reference_camera, reference_gaussians,
    },
};
pub use glam::{DMat3, DQuat, DVec3};
pub use std::{
    fs,
    ops::ControlFlow,
    path::{Path, PathBuf},
};
pub use zipsplat::{
    Error,
    gpu::{Device, DeviceOptions, Element, Limits, Recorder, Run, Tensor},
    ops::{Arithmetic, Precision, Rows},
    random::Random,
    reconstruct::{KvPool, Model, Ratio, ReconstructOptions, Reconstruction, TokenSelection},
    stages::render::{Depth, RenderOptions, RenderOutput, Renderer},
    types::{Camera, Image, Intrinsics, Pose, Scene, matrix_from_quaternion, poses::Capture},
    weights::{Architecture, Checkpoint, Dtype},
};
pub use zipsplat_verify::network;
