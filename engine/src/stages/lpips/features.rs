use crate::{
    gpu::{Element, Recorder},
    kernels::{lpips as kernels, ops::Im2col},
    ops::{Epilogue, FeatureMap, Linear, Rows, row_chunks},
};
/// Fraction of a binding per step, to bound scratch.
const SHARE: usize = 8;

pub struct Convolution {
    pub layer: Linear,
    pub side: usize,
    pub step: usize,
    pub padding: usize,
    /// Zero-insertion stride.
    pub spread: usize,
}

pub enum Inputs {
    AsTheyAre,
    Rectified,
    Gated(FeatureMap),
}

#[derive(Clone, Copy)]
pub struct Pool {
    pub side: usize,
    pub step: usize,
}

impl Convolution {
    pub fn record(
        &self,
        rec: &mut Recorder,
        name: &str,
        source: FeatureMap,
        inputs: Inputs,
        out: [usize; 2],
    ) -> FeatureMap {
        let out = FeatureMap::scratch(rec, name, out, self.layer.columns);
        let inner = self.layer.inner;
        for part in row_chunks(rec, out.rows.count, &[SHARE * 4 * inner, out.rows.row_bytes()]) {
            let lines = part.start / out.width..(part.end - 1) / out.width + 1;
            let first = (lines.start * self.step).saturating_sub(self.padding) / self.spread;
            let last = ((lines.end - 1) * self.step + self.side).saturating_sub(self.padding + 1) / self.spread;
            let seen = first.min(source.height - 1)..(last + 1).clamp(1, source.height);
            let (values, source_first) = source.seen(seen.clone());
            let patches = Rows::scratch(rec, "patches", part.len(), inner, Element::F32);
            let kernel = Im2col {
                source: values,
                gate: if let Inputs::Gated(gate) = &inputs { gate.seen(seen).0 } else { values },
                out: patches.tensor,
                rows: part.len() as u32,
                row: inner as u32,
                first: part.start as u32,
                out_width: out.width as u32,
                channels: source.channels() as u32,
                width: source.width as u32,
                height: source.height as u32,
                source_first,
                side: self.side as u32,
                step: self.step as u32,
                padding: self.padding as u32,
                spread: self.spread as u32,
                rectified: matches!(inputs, Inputs::Rectified),
                gated: matches!(inputs, Inputs::Gated(_)),
            };
            rec.dispatch_groups(kernel, part.len());
            self.layer.record(rec, patches, out.rows.part(part), Epilogue::default());
        }
        out
    }
}

impl Pool {
    pub fn size(&self, source: FeatureMap) -> [usize; 2] {
        source.size().map(|side| (side - self.side) / self.step + 1)
    }

    /// Max pooling with ReLU.
    pub fn forward(&self, rec: &mut Recorder, source: FeatureMap) -> FeatureMap {
        let out = FeatureMap::scratch(rec, "pooled", self.size(source), source.channels());
        for lines in row_chunks(rec, out.height, &[source.line_bytes() * self.step, out.line_bytes()]) {
            let seen = lines.start * self.step..(lines.end - 1) * self.step + self.side;
            let (values, source_first) = source.seen(seen);
            let count = lines.len() * out.width * out.channels();
            let kernel = kernels::Pool {
                source: values,
                out: out.lines(lines.clone()),
                count: count as u32,
                first: lines.start as u32,
                out_width: out.width as u32,
                channels: out.channels() as u32,
                width: source.width as u32,
                source_first,
                side: self.side as u32,
                step: self.step as u32,
            };
            rec.dispatch(kernel, count);
        }
        out
    }

    pub fn backward(&self, rec: &mut Recorder, source: FeatureMap, d_out: FeatureMap) -> FeatureMap {
        let d = FeatureMap::scratch(rec, "d_pooled", source.size(), source.channels());
        for lines in row_chunks(rec, d.height, &[2 * d.line_bytes()]) {
            let windows = (lines.start.max(self.side - 1) + 1 - self.side).div_ceil(self.step)
                ..((lines.end - 1) / self.step + 1).min(d_out.height);
            let windows = windows.start.min(d_out.height - 1)..windows.end.max(1);
            let seen = (windows.start * self.step).min(lines.start)
                ..((windows.end - 1) * self.step + self.side).max(lines.end);
            let ((values, source_first), (d_values, out_first)) = (source.seen(seen), d_out.seen(windows));
            let count = lines.len() * d.width * d.channels();
            let kernel = kernels::PoolBackward {
                source: values,
                d_out: d_values,
                d_source: d.lines(lines.clone()),
                count: count as u32,
                first: lines.start as u32,
                out_first,
                out_width: d_out.width as u32,
                out_height: d_out.height as u32,
                channels: d.channels() as u32,
                width: d.width as u32,
                source_first,
                side: self.side as u32,
                step: self.step as u32,
            };
            rec.dispatch(kernel, count);
        }
        d
    }
}
