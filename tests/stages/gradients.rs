//! Gradients through the head against those of the PyTorch implementation.

use std::ops::ControlFlow;
use std::sync::Arc;
use zipsplat::gpu::{Recorder, Run};
use zipsplat::ops::{Arithmetic, ParameterLayout};
use zipsplat::stages::gaussians::Head;
use zipsplat::stages::render::{SceneGradients, SceneTensors};
use zipsplat::weights::Checkpoint;
use zipsplat_tests::architectures;
use zipsplat_tests::compare::{Tolerance, assert_close, columns};
use zipsplat_tests::device::device;
use zipsplat_tests::golden::{self, Golden};

fn rms(rms: f64) -> Tolerance {
    Tolerance { max: f64::INFINITY, rms }
}

/// The head of a golden's network with its weights.
fn head(config: &str) -> (Head, Arc<zipsplat::gpu::Resident>) {
    let architecture = architectures::golden(config);
    let mut parameters = ParameterLayout::new(device().limits(), Arithmetic::EXACT);
    let head = Head::new(&mut parameters, &architecture);
    let checkpoint = Checkpoint::seeded_architecture(architecture, config).expect("a golden's network");
    let resident = parameters.load(device(), &checkpoint, |_| ControlFlow::Continue(())).expect("a small head fits");
    (head, Arc::new(resident))
}

#[test]
fn head_of_the_goldens() {
    for golden in golden::list("grad_head").iter().filter_map(|file| Golden::open(file)) {
        let (head, resident) = head(golden.metadata("config"));
        let (count, gaussians, width) =
            (golden.shape("tokens")[0], golden.shape("step0/gauss")[0], golden.shape("step0/gauss")[1]);
        for stem in golden.stems("/d_gauss") {
            let mut rec = Recorder::new(device().limits()).observing();
            let tokens = rec.input::<f32>("tokens", golden.f32("tokens").len());
            let unit = rec.input::<f32>("unit", 1);
            let bases = (width - 11) / 3;
            let scene = SceneTensors::output(&mut rec, gaussians, bases.isqrt() as u32 - 1);
            let kept = head.record(&mut rec, tokens, count, unit, &scene);
            let fields = [0, 3, 6, 10, 11, width].windows(2).map(|w| [w[0], w[1]]).collect::<Vec<_>>();
            let tensor =
                |rec: &mut Recorder, [start, end]: [usize; 2]| rec.input::<f32>("d", gaussians * (end - start));
            let d: Vec<_> = fields.iter().map(|field| tensor(&mut rec, *field)).collect();
            let d_gaussians =
                SceneGradients { means: d[0], scales: d[1], quats: d[2], opacities: d[3], sh_coeffs: d[4] };
            head.record_backward(&mut rec, &kept, &d_gaussians);
            let mut run = Run::with_resident(device(), rec.finish().unwrap(), Some(resident.clone())).unwrap();
            run.write(unit, &[1.0f32]).unwrap();
            run.write(tokens, &golden.f32("tokens")).unwrap();
            for (tensor, [start, end]) in d.iter().zip(fields) {
                let values = columns(&golden.f32(&format!("{stem}/d_gauss")), width, start, end);
                run.write(*tensor, &values.iter().map(|x| *x as f32).collect::<Vec<_>>()).unwrap();
            }
            run.execute().unwrap();
            for (name, tensor) in run.observed() {
                let got = run.read::<f32>(*tensor).unwrap();
                let short = name.rsplit('/').next().unwrap();
                if short == "raw" {
                    assert_close("raw", &got, &golden.f32("step0/raw"), Tolerance::of_field("raw"));
                } else {
                    let name = format!("{} {stem}/{short}", golden.file());
                    let found = assert_close(&name, &got, &golden.f64(&format!("{stem}/{short}")), rms(5e-5));
                    println!("{name}: {:.1e}", found.rms);
                }
            }
        }
    }
}
