use crate::case::*;
use zipsplat::{kernels::render::Project, stages::render::camera_rows, types::NEAR};

/// Rows per Gaussian and camera, Gaussian-major.
struct Projection {
    xy_opacities: Vec<[f32; 3]>,
    conics: Vec<[f32; 3]>,
    colors: Vec<[f32; 3]>,
    depths: Vec<f32>,
    tile_sets: Vec<[u32; 3]>,
}

fn project(scene: &Scene, cameras: &[Camera], antialiased: bool) -> Projection {
    let mut case = plan();
    let pairs = scene.len() * cameras.len();
    let kernel = Project {
        means: case.input(&scene.means),
        scales: case.input(&scene.scales),
        quats: case.input(&scene.quats),
        opacities: case.input(&scene.opacities),
        sh_coeffs: case.input(&scene.sh_coeffs),
        cameras: case.input(&cameras.iter().map(camera_rows).collect::<Vec<_>>()),
        xy_opacities: case.output::<[f32; 3]>(pairs),
        conics: case.output::<[f32; 3]>(pairs),
        colors: case.output::<[f32; 3]>(pairs),
        depths: case.output::<f32>(pairs),
        tile_sets: case.output::<[u32; 3]>(pairs),
        indices: case.output::<u32>(pairs),
        pairs: pairs as u32,
        first_pair: 0,
        camera_count: cameras.len() as u32,
        width: cameras[0].intrinsics.width,
        height: cameras[0].intrinsics.height,
        near: NEAR,
        color: true,
        sh_degree: scene.sh_degree,
        antialiased,
    };
    case.rec.dispatch(kernel, pairs);
    let run = case.run().unwrap();
    assert_same("indices", &run.read::<u32>(kernel.indices).unwrap(), &(0..pairs as u32).collect::<Vec<_>>());
    Projection {
        xy_opacities: run.read(kernel.xy_opacities).unwrap(),
        conics: run.read(kernel.conics).unwrap(),
        colors: run.read(kernel.colors).unwrap(),
        depths: run.read(kernel.depths).unwrap(),
        tile_sets: run.read(kernel.tile_sets).unwrap(),
    }
}

#[test]
fn equals_the_goldens() {
    for file in golden::list("raster.") {
        let Some(golden) = Golden::open(&file).filter(|g| g.has("proj/classic/ok")) else { continue };
        let (scene, cameras) = (golden_scene(&golden), golden_cameras(&golden));
        for mode in ["classic", "antialiased"] {
            let got = project(&scene, &cameras, mode == "antialiased");
            compare(&golden, &format!("proj/{mode}"), &got, scene.len(), cameras.len());
        }
    }
}

fn compare(golden: &Golden, key: &str, got: &Projection, gaussians: usize, cameras: usize) {
    let truth = |field: &str| golden.f64(&format!("{key}/{field}"));
    let ok = golden.u8(&format!("{key}/ok"));
    let seen: Vec<(usize, usize)> =
        (0..ok.len()).filter(|&i| ok[i] != 0).map(|i| (i, i % gaussians * cameras + i / gaussians)).collect();
    let name = |field: &str| format!("{} {key}/{field}", golden.file());
    for (i, drawn) in ok.iter().enumerate() {
        let pair = i % gaussians * cameras + i / gaussians;
        let visible = got.depths[pair].is_finite();
        // A Gaussian between pixel centers touches no tile of its box.
        assert!(!visible || *drawn != 0, "{}: {i} is drawn", name("ok"));
        assert!(visible || *drawn == 0 || got.tile_sets[pair] == [0; 3], "{}: {i} is not drawn", name("ok"));
    }
    let drawn: Vec<_> = seen.into_iter().filter(|(_, pair)| got.depths[*pair].is_finite()).collect();
    let pick = |values: &[f64], width: usize| -> Vec<f64> {
        drawn.iter().flat_map(|(i, _)| values[i * width..][..width].to_vec()).collect()
    };
    let mine = |values: &[[f32; 3]]| -> Vec<f32> { drawn.iter().flat_map(|(_, pair)| values[*pair]).collect() };
    // Thousands of pixels from the origin, a few roundings.
    let tolerance = Tolerance { max: 4e-6, rms: 1e-6 };
    let xy_opacities = mine(&got.xy_opacities);
    assert_close(&name("means2d"), &columns(&xy_opacities, 3, 0, 2), &pick(&truth("means2d"), 2), tolerance);
    assert_close(&name("opac"), &columns(&xy_opacities, 3, 2, 3), &pick(&truth("opac"), 1), tolerance);
    assert_close(&name("color"), &mine(&got.colors), &pick(&truth("color"), 3), tolerance);
    let depths: Vec<f32> = drawn.iter().map(|(_, pair)| got.depths[*pair]).collect();
    assert_close(&name("depth"), &depths, &pick(&truth("depth"), 1), tolerance);
    let conics: Vec<f64> = mine(&got.conics)
        .chunks_exact(3)
        .flat_map(|c| {
            let [a, k, p] = [c[0], c[1], c[2]].map(f64::from);
            [a, -a * k, a * k * k + p]
        })
        .collect();
    assert_close(&name("conic"), &conics, &pick(&truth("conic"), 3), Tolerance { max: 2e-5, rms: 4e-6 });

    let (first, end) = (golden.u32(&format!("{key}/tmin")), golden.u32(&format!("{key}/tmax")));
    for (i, pair) in drawn {
        let [corner, size, _] = got.tile_sets[pair].map(|word| [word & 0xffff, word >> 16]);
        let box_of = |c: usize| (first[2 * i + c], end[2 * i + c] - first[2 * i + c]);
        assert_eq!([(corner[0], size[0]), (corner[1], size[1])], [box_of(0), box_of(1)], "{} of {i}", name("tiles"));
    }
}
