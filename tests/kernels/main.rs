//! Kernels against references in f64 that use other algorithms, on the device that is there.

mod ops {
    mod scan;
    mod sort;
}
mod render {
    mod intersect;
    mod project;
    mod rasterise;
}
