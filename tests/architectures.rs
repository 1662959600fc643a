use zipsplat::weights::{Architecture, DepthArchitecture, Ffn};

/// Networks of the goldens (golden/FORMAT.md, section 3). Weights are seeded by the golden's name,
/// `tiny` for `tiny_rect`.
pub fn golden(name: &str) -> Architecture {
    match name {
        "tiny" | "tiny_eps" | "tiny_rect" => Architecture::new(name, 128, 6, 2, &[3, 4, 5]),
        "tiny_swiglu" => Architecture {
            ffn: Ffn::SwiGlu,
            ffn_hidden: 344,
            qk_norm_start: 2,
            rope_start: 4,
            ..Architecture::new(name, 128, 6, 3, &[1, 3, 5])
        },
        "micro" => Architecture {
            position_grid: 5,
            color_width: 32,
            color_heads: 1,
            color_hidden: 64,
            head_hidden: 2 * (64 + 32),
            gaussians_per_token: 4,
            sh_degree: 2,
            ..Architecture::new(name, 64, 3, 1, &[1, 2])
        },
        "small" => Architecture { name: name.into(), ..Architecture::named("vits").expect("a named variant") },
        "giant_slice" => {
            Architecture { ffn: Ffn::SwiGlu, ffn_hidden: 4096, ..Architecture::new(name, 1536, 4, 1, &[3]) }
        }
        _ => panic!("no golden is called {name}"),
    }
}

/// Minimal and multi-view, without the Gaussian head.
pub fn depth_micro() -> DepthArchitecture {
    DepthArchitecture::new("da3-micro", [64, 4, 1], Ffn::Gelu, [0, 1, 2, 3], 8, [8, 8, 8, 8])
}

pub fn depth_micro_alone() -> DepthArchitecture {
    DepthArchitecture::new("da3-micro-alone", [64, 4, 4], Ffn::Gelu, [0, 1, 2, 3], 8, [8, 8, 8, 8])
}

/// Returns a small network on VGGT with two feature pairs of three.
pub fn vggt_micro() -> Architecture {
    let like = Architecture::vggt("vggt-micro", 64, [2, 3], &[1, 2]);
    Architecture { position_grid: 5, gaussians_per_token: 4, ..like }
}

/// The smallest with every kind of parameter, seeded by `pico`.
pub fn pico() -> Architecture {
    Architecture {
        patch_size: 2,
        position_grid: 3,
        camera_depth: 1,
        camera_heads: 2,
        color_width: 8,
        color_heads: 1,
        color_hidden: 8,
        head_hidden: 16,
        gaussians_per_token: 2,
        ..Architecture::new("pico", 16, 2, 1, &[0, 1])
    }
}
