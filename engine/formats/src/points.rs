//! Scenes from point clouds.

use crate::{Camera, Error, PointCloud, Result, SH_0, Scene};
use glam::DVec3;
use rayon::prelude::*;
use rstar::{RTree, primitives::GeomWithData};
use std::iter::repeat_n;

const NEIGHBORS: usize = 3;
/// Maximum Gaussian size over the nearest camera's distance, for isolated wrong points.
const LARGEST: f64 = 0.1;
const OPACITY: f32 = 0.5;
/// Few photos' views do not determine more.
const DEGREE: u32 = 1;

impl Scene {
    /// Creates an isotropic Gaussian per point. Its standard deviation is the root mean square
    /// distance to the three nearest points elsewhere (Kerbl et al. 2023).
    ///
    /// # Errors
    /// [`Error::Argument`] without two distinct points.
    pub fn from_points(cloud: &PointCloud, cameras: &[Camera]) -> Result<Self> {
        let mut sorted = cloud.positions.clone();
        sorted.par_sort_unstable_by_key(|at| at.map(f32::to_bits));
        let places =
            sorted.chunk_by(|a, b| a == b).map(|equal| GeomWithData::new(equal[0].map(f64::from), equal.len()));
        let tree = RTree::bulk_load(places.collect());
        let centers: Vec<DVec3> = cameras.iter().map(|camera| camera.pose.translation).collect();
        let size = |at: &[f32; 3]| {
            let at = at.map(f64::from);
            let others = tree.nearest_neighbor_iter_with_distance_2(at).filter(|(_, square)| *square > 0.0);
            let squares = others.flat_map(|(place, square)| repeat_n(square, place.data));
            let nearest: Vec<f64> = squares.take(NEIGHBORS).collect();
            let size = (nearest.iter().sum::<f64>() / nearest.len() as f64).sqrt();
            let distances = centers.iter().map(|center| center.distance(DVec3::from(at)));
            size.min(LARGEST * distances.fold(f64::INFINITY, f64::min)) as f32
        };
        let count = cloud.positions.len();
        if cloud.positions.iter().all(|at| *at == cloud.positions[0]) {
            let found = format!("{count} at one place");
            return Err(Error::argument("points to start from", found, "points at several places"));
        }
        let scales: Vec<[f32; 3]> = cloud.positions.par_iter().map(|at| [size(at); 3]).collect();
        let color = |i: usize| {
            cloud.colors.get(i).unwrap_or(&PointCloud::GRAY).map(|value| (f32::from(value) / 255.0 - 0.5) / SH_0)
        };
        let scene = Scene {
            means: cloud.positions.clone(),
            scales,
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacities: vec![OPACITY; count],
            sh_coeffs: (0..count).map(color).collect(),
            ..Self::default()
        };
        Ok(with_degree(scene, DEGREE))
    }

    /// Concatenates two scenes with the higher degree of harmonics.
    ///
    /// # Errors
    /// [`Error::Argument`] if only one is antialiased: no option of the renderer suits both.
    pub fn concat(first: Self, second: Self) -> Result<Self> {
        if first.antialiased != second.antialiased {
            let found = "an antialiased scene and one that is not";
            return Err(Error::argument("scenes to merge", found, "all antialiased, or none"));
        }
        let degree = first.sh_degree.max(second.sh_degree);
        let [mut joined, other] = [first, second].map(|scene| with_degree(scene, degree));
        joined.append(other);
        Ok(joined)
    }
}

fn with_degree(mut scene: Scene, degree: u32) -> Scene {
    let (own, wanted) = (scene.sh_coeffs_per_gaussian(), (degree as usize + 1).pow(2));
    if own < wanted {
        let padded = |coeffs: &[[f32; 3]]| -> Vec<[f32; 3]> {
            let zeros = vec![[0.0; 3]; wanted - own];
            coeffs.iter().copied().chain(zeros).collect()
        };
        scene.sh_coeffs = scene.sh_coeffs.chunks_exact(own).flat_map(padded).collect();
        scene.sh_degree = degree;
    }
    scene
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Intrinsics, Pose};

    #[test]
    fn gaussians_are_as_large_as_their_neighbors_are_far() {
        let positions: Vec<[f32; 3]> = [0.0, 1.0, 2.0, 3.0, 3.0].map(|x| [x, 0.0, 0.0]).to_vec();
        let cloud = PointCloud { positions, colors: vec![[255, 0, 128]; 5] };
        let scene = Scene::from_points(&cloud, &[]).expect("a scene");
        scene.validate().expect("a valid scene");
        // Equal points are not each other's neighbors.
        let expected = [14.0f32, 6.0, 3.0, 14.0, 14.0].map(|squares| (squares / 3.0).sqrt());
        for (scale, expected) in scene.scales.iter().zip(expected) {
            assert!((scale[0] - expected).abs() < 1e-6, "{scale:?}, not {expected}");
        }
        let color = scene.sh_coeffs[0].map(|value| SH_0 * value + 0.5);
        assert!((color[0] - 1.0).abs() < 1e-6 && color[1].abs() < 1e-6);
        let camera = Camera { intrinsics: Intrinsics::from_fov(8, 8, 1.0, 1.0), pose: Pose::IDENTITY };
        assert_eq!(Scene::from_points(&cloud, &[camera]).expect("a scene").scales[2], [0.2; 3]);
        Scene::from_points(&PointCloud { positions: vec![[1.0; 3]; 4], colors: Vec::new() }, &[]).unwrap_err();
        let positions = [vec![[0.0; 3]; 200_000], vec![[0.0, 0.0, 2.0]]].concat();
        let equal = Scene::from_points(&PointCloud { positions, colors: Vec::new() }, &[]).expect("a scene");
        assert!(equal.scales.iter().all(|scale| *scale == [2.0; 3]));
    }

    #[test]
    fn scenes_of_two_degrees_are_joined() {
        let of_degree = |sh_degree: u32| Scene {
            means: vec![[0.0; 3]; 2],
            scales: vec![[1.0; 3]; 2],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacities: vec![0.5; 2],
            sh_coeffs: (0..2 * (sh_degree + 1).pow(2)).map(|i| [1.0 + i as f32; 3]).collect(),
            sh_degree,
            antialiased: false,
        };
        let joined = Scene::concat(of_degree(0), of_degree(1)).expect("a scene");
        joined.validate().expect("a valid scene");
        let first: Vec<f32> = joined.sh_coeffs.iter().map(|coeffs| coeffs[0]).collect();
        assert_eq!(first, [1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]);
    }
}
