use glam::{Vec2, Vec3A, Vec3Swizzles};

const BLOCK: usize = 8;

/// Heights over `[-half_side, half_side]` in x and y. A cell's diagonal joins low and high corners.
pub struct HeightField {
    half_side: f32,
    cells: usize,
    /// `[cells + 1][cells + 1]`, y before x, in meters.
    heights: Vec<f32>,
    normals: Vec<Vec3A>,
    /// Lowest and highest corner of each cell.
    ranges: Vec<[f32; 2]>,
    blocks: Vec<[f32; 2]>,
    max_height: f32,
}

impl HeightField {
    pub(super) fn new(half_side: f32, cells: usize, height: impl Fn(Vec2) -> f32) -> Self {
        let step = 2.0 * half_side / cells as f32;
        let at = |i: usize, j: usize| Vec2::new(i as f32, j as f32) * step - half_side;
        let grid = || (0..=cells).flat_map(|j| (0..=cells).map(move |i| (i, j)));
        let heights: Vec<f32> = grid().map(|(i, j)| height(at(i, j))).collect();
        let corner = |i: usize, j: usize| heights[j * (cells + 1) + i];
        let normals = grid()
            .map(|(i, j)| {
                let slope = |low: f32, high: f32, from: usize, to: usize| (high - low) / ((to - from) as f32 * step);
                let ([i0, i1], [j0, j1]) =
                    ([i.saturating_sub(1), cells.min(i + 1)], [j.saturating_sub(1), cells.min(j + 1)]);
                let dx = slope(corner(i0, j), corner(i1, j), i0, i1);
                let dy = slope(corner(i, j0), corner(i, j1), j0, j1);
                Vec3A::new(-dx, -dy, 1.0).normalize()
            })
            .collect();
        let ranges = (0..cells * cells)
            .map(|cell| {
                let (i, j) = (cell % cells, cell / cells);
                let corners = [corner(i, j), corner(i + 1, j), corner(i, j + 1), corner(i + 1, j + 1)];
                [corners.into_iter().fold(f32::MAX, f32::min), corners.into_iter().fold(f32::MIN, f32::max)]
            })
            .collect::<Vec<[f32; 2]>>();
        let mut blocks = vec![[f32::MAX, f32::MIN]; cells.div_ceil(BLOCK).pow(2)];
        for (cell, [low, high]) in ranges.iter().enumerate() {
            let block = &mut blocks[cell / cells / BLOCK * cells.div_ceil(BLOCK) + cell % cells / BLOCK];
            *block = [block[0].min(*low), block[1].max(*high)];
        }
        let max_height = heights.iter().fold(1e-3, |most: f32, height| most.max(height.abs()));
        Self { half_side, cells, heights, normals, ranges, blocks, max_height }
    }

    /// Returns the side of a cell in meters.
    pub fn step(&self) -> f32 {
        2.0 * self.half_side / self.cells as f32
    }

    pub fn cells(&self) -> usize {
        self.cells
    }

    pub fn corner(&self, i: usize, j: usize) -> Vec3A {
        let xy = Vec2::new(i as f32, j as f32) * self.step() - self.half_side;
        xy.extend(self.heights[j * (self.cells + 1) + i]).into()
    }

    pub(super) fn extent(&self) -> Vec3A {
        Vec3A::new(self.half_side, self.half_side, self.max_height)
    }

    /// Cell, and offset in it, 0..1.
    fn cell(&self, p: Vec2) -> ([usize; 2], Vec2) {
        let scaled = (p + self.half_side) / self.step();
        let clamped = scaled.clamp(Vec2::ZERO, Vec2::splat(self.cells as f32 - 1e-3));
        let floor = clamped.floor();
        ([floor.x as usize, floor.y as usize], clamped - floor)
    }

    /// `None` outside.
    pub(super) fn height(&self, p: Vec2) -> Option<f32> {
        let ([i, j], f) = self.cell(p);
        let [low, dx, dy] = self.plane(i, j, f.x >= f.y);
        p.abs().cmple(Vec2::splat(self.half_side)).all().then_some(low + dx * f.x + dy * f.y)
    }

    /// Corner height, and slopes per cell, of one triangle.
    fn plane(&self, i: usize, j: usize, lower: bool) -> [f32; 3] {
        let row = self.cells + 1;
        let at = j * row + i;
        let [h00, h10, h01, h11] = [at, at + 1, at + row, at + row + 1].map(|k| self.heights[k]);
        if lower { [h00, h10 - h00, h11 - h10] } else { [h00, h11 - h01, h01 - h00] }
    }

    pub(super) fn normal(&self, p: Vec2) -> Vec3A {
        let ([i, j], f) = self.cell(p);
        let row = self.cells + 1;
        let at = j * row + i;
        let low = self.normals[at].lerp(self.normals[at + 1], f.x);
        let high = self.normals[at + row].lerp(self.normals[at + row + 1], f.x);
        low.lerp(high, f.y).normalize()
    }

    /// Walks the cells under the ray (Amanatides and Woo 1987), skipping blocks by height.
    pub(super) fn intersect(&self, origin: Vec3A, direction: Vec3A, limit: f32) -> Option<f32> {
        let [enter, leave] = slab(origin, direction, self.extent() + 1e-3)?;
        let (mut t, end) = (enter.max(0.0), leave.min(limit));
        let (start, _) = self.cell((origin + direction * t).xy());
        let mut at = start.map(|k| k as isize);
        let walk =
            Walk { origin: origin.xy(), inverse: direction.xy().recip(), step: self.step(), low: -self.half_side };
        while t <= end {
            let block = at.map(|k| k / BLOCK as isize * BLOCK as isize);
            let (next, axis) = walk.leave(block, BLOCK as isize);
            let [lowest, highest] =
                self.blocks[block[1] as usize / BLOCK * self.cells.div_ceil(BLOCK) + block[0] as usize / BLOCK];
            let heights = [t, next.min(end)].map(|t| origin.z + direction.z * t);
            if heights[0].min(heights[1]) > highest || heights[0].max(heights[1]) < lowest {
                t = next.max(t);
                let across = walk.cell(1 - axis, direction.xy(), t);
                at[1 - axis] = across.clamp(block[1 - axis], block[1 - axis] + BLOCK as isize - 1);
                at[axis] = if direction[axis] > 0.0 { block[axis] + BLOCK as isize } else { block[axis] - 1 };
            } else {
                let (next, axis) = walk.leave(at, 1);
                let next = next.max(t);
                let hit = self.intersect_cell(at[0] as usize, at[1] as usize, origin, direction, [t, next]);
                if hit.is_some() {
                    return hit;
                }
                t = next;
                at[axis] += if direction[axis] > 0.0 { 1 } else { -1 };
            }
            if at.iter().any(|k| !(0..self.cells as isize).contains(k)) {
                return None;
            }
        }
        None
    }

    fn intersect_cell(&self, i: usize, j: usize, o: Vec3A, d: Vec3A, [from, to]: [f32; 2]) -> Option<f32> {
        let [lowest, highest] = self.ranges[j * self.cells + i];
        let (z0, z1) = (o.z + d.z * from, o.z + d.z * to);
        if z0.min(z1) > highest || z0.max(z1) < lowest {
            return None;
        }
        let step = self.step();
        let corner = Vec2::new(i as f32, j as f32) * step - self.half_side;
        let (f, df) = ((o.xy() - corner) / step, d.xy() / step);
        // Prevents gaps between cells and triangles.
        let slack = 1e-4 * (1.0 + to);
        let hit = |lower: bool| {
            let [low, dx, dy] = self.plane(i, j, lower);
            let t = (low + dx * f.x + dy * f.y - o.z) / (d.z - dx * df.x - dy * df.y);
            let across = (f.x + t * df.x) - (f.y + t * df.y);
            let inside = if lower { across >= -1e-4 } else { across <= 1e-4 };
            (inside && t >= from - slack && t <= to + slack).then_some(t)
        };
        match (hit(true), hit(false)) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }
}

struct Walk {
    origin: Vec2,
    inverse: Vec2,
    step: f32,
    low: f32,
}

impl Walk {
    /// Distance and axis of the exit from `size` cells after `first`.
    fn leave(&self, first: [isize; 2], size: isize) -> (f32, usize) {
        let exit = |axis: usize| {
            let inverse = self.inverse[axis];
            let border = if inverse > 0.0 { first[axis] + size } else { first[axis] };
            let t = (border as f32 * self.step + self.low - self.origin[axis]) * inverse;
            if inverse.is_finite() { t } else { f32::INFINITY }
        };
        let (x, y) = (exit(0), exit(1));
        if x < y { (x, 0) } else { (y, 1) }
    }

    fn cell(&self, axis: usize, direction: Vec2, t: f32) -> isize {
        ((self.origin[axis] + direction[axis] * t - self.low) / self.step).floor() as isize
    }
}

/// Kay and Kajiya's slabs. For rays along a face, min and max drop NaN.
pub(super) fn slab(origin: Vec3A, direction: Vec3A, half: Vec3A) -> Option<[f32; 2]> {
    let inverse = direction.recip();
    let (a, b) = ((-half - origin) * inverse, (half - origin) * inverse);
    let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
    (enter <= leave).then_some([enter, leave])
}
