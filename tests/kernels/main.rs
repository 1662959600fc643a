//! Kernels against f64 references by other algorithms.

mod arena;
mod case;
mod catalog;
mod determinism;
mod self_test;
mod tuning;

mod backbone {
    mod average_halves;
    mod camera_token;
    mod patchify;
    mod reference_view;
    mod tokens;
}
mod cluster {
    mod halves;
    mod mean;
    mod mutual;
    mod nearest;
    mod origin;
    mod panels;
}
mod gaussians {
    mod activate;
    mod activate_backward;
}
mod heads {
    mod convolution;
}
mod loss {
    mod depth;
    mod gradient;
    mod targets;
}
mod lpips {
    mod compare;
    mod normalize;
    mod pool;
}
mod measure {
    mod copy;
    mod fma;
    mod matrix;
}
mod ops {
    mod add;
    mod gather_rows;
    mod gelu;
    mod im2col;
    mod layer_norm;
    mod linear;
    mod place_columns;
    mod quantize_rows;
    mod sort;
    mod split_heads;
}
mod refine {
    mod adam;
    mod anisotropy;
    mod dropout;
    mod exposure;
}
mod render {
    mod backward;
    mod intersect;
    mod normals;
    mod pack;
    mod project;
    mod rasterize;
}
