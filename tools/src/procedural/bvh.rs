//! Bounding volume hierarchy by the surface area heuristic (Wald 2007, full sweeps).

use glam::Vec3A;

use super::shape::Primitive;

const LEAF: usize = 2;
/// Depth where halving of nodes starts, to bound the stack for up to 2^11 primitives.
const DEEP: usize = 20;
const STACK: usize = 32;

#[derive(Clone, Copy)]
struct Aabb {
    low: Vec3A,
    high: Vec3A,
}

impl Aabb {
    const EMPTY: Self = Self { low: Vec3A::MAX, high: Vec3A::MIN };

    fn union(self, other: Self) -> Self {
        Self { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    fn area(self) -> f32 {
        let side = (self.high - self.low).max(Vec3A::ZERO);
        side.x * side.y + side.y * side.z + side.z * side.x
    }

    fn enter(&self, origin: Vec3A, inverse: Vec3A, limit: f32) -> Option<f32> {
        let (a, b) = ((self.low - origin) * inverse, (self.high - origin) * inverse);
        let (enter, leave) = (a.min(b).max_element().max(0.0), a.max(b).min_element().min(limit));
        (enter <= leave).then_some(enter)
    }
}

struct Node {
    bounds: Aabb,
    /// First item of a leaf, or second child of an inner node, whose first child follows it.
    first: u32,
    /// 0 for an inner node.
    count: u32,
}

pub(super) struct Bvh {
    nodes: Vec<Node>,
    items: Vec<u32>,
}

impl Bvh {
    pub fn new(primitives: &[Primitive]) -> Self {
        let bounds = |primitive: &Primitive| {
            let (center, extent) = (primitive.center, primitive.extent() + 1e-4);
            Aabb { low: center - extent, high: center + extent }
        };
        let boxes: Vec<Aabb> = primitives.iter().map(bounds).collect();
        let mut bvh = Self { nodes: Vec::new(), items: (0..primitives.len() as u32).collect() };
        if !boxes.is_empty() {
            bvh.build(&boxes, 0, boxes.len(), 0);
        }
        bvh
    }

    fn build(&mut self, boxes: &[Aabb], start: usize, end: usize, depth: usize) {
        let of = |item: &u32| boxes[*item as usize];
        let bounds = self.items[start..end].iter().map(of).fold(Aabb::EMPTY, Aabb::union);
        let node = self.nodes.len();
        self.nodes.push(Node { bounds, first: start as u32, count: (end - start) as u32 });
        if end - start <= LEAF {
            return;
        }
        let (_, axis, left) = (0..3)
            .map(|axis| self.best_split(boxes, start, end, axis))
            .fold((f32::INFINITY, 0, 1), |best, split| if split.0 < best.0 { split } else { best });
        sort_along(&mut self.items[start..end], boxes, axis);
        let left = if depth < DEEP { left } else { (end - start) / 2 };
        self.build(boxes, start, start + left, depth + 1);
        self.nodes[node].first = self.nodes.len() as u32;
        self.nodes[node].count = 0;
        self.build(boxes, start + left, end, depth + 1);
    }

    /// Cost, axis and left item count.
    fn best_split(&mut self, boxes: &[Aabb], start: usize, end: usize, axis: usize) -> (f32, usize, usize) {
        let items = &mut self.items[start..end];
        sort_along(items, boxes, axis);
        let mut right = vec![0.0; items.len()];
        let mut bounds = Aabb::EMPTY;
        for k in (1..items.len()).rev() {
            bounds = bounds.union(boxes[items[k] as usize]);
            right[k] = bounds.area() * (items.len() - k) as f32;
        }
        let (mut bounds, mut best) = (Aabb::EMPTY, (f32::INFINITY, axis, 1));
        for k in 1..items.len() {
            bounds = bounds.union(boxes[items[k - 1] as usize]);
            let cost = bounds.area() * k as f32 + right[k];
            if cost < best.0 {
                best = (cost, axis, k);
            }
        }
        best
    }

    pub fn nearest(
        &self,
        primitives: &[Primitive],
        origin: Vec3A,
        direction: Vec3A,
        limit: f32,
    ) -> Option<(f32, usize)> {
        let mut best = None;
        self.visit(origin, direction, limit, |item, limit| {
            let t = primitives[item].intersect(origin, direction, limit)?;
            best = Some((t, item));
            Some(t)
        });
        best
    }

    pub fn occluded(&self, primitives: &[Primitive], origin: Vec3A, direction: Vec3A, limit: f32) -> bool {
        let mut found = false;
        self.visit(origin, direction, limit, |item, limit| {
            found = primitives[item].intersect(origin, direction, limit).is_some();
            // A negative limit ends the visit.
            found.then_some(-1.0)
        });
        found
    }

    /// Calls `hit(item, limit)`, which returns the new limit, nearest boxes first.
    fn visit(&self, origin: Vec3A, direction: Vec3A, mut limit: f32, mut hit: impl FnMut(usize, f32) -> Option<f32>) {
        let inverse = direction.recip();
        let (mut stack, mut depth) = ([(0u32, 0f32); STACK], 0);
        let push = |stack: &mut [(u32, f32); STACK], depth: &mut usize, node: u32, limit: f32| {
            if let Some(enter) = self.nodes[node as usize].bounds.enter(origin, inverse, limit) {
                stack[*depth] = (node, enter);
                *depth += 1;
            }
        };
        if !self.nodes.is_empty() {
            push(&mut stack, &mut depth, 0, limit);
        }
        while depth > 0 {
            depth -= 1;
            let (index, enter) = stack[depth];
            if enter > limit {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                for item in &self.items[node.first as usize..(node.first + node.count) as usize] {
                    limit = hit(*item as usize, limit).unwrap_or(limit);
                }
                continue;
            }
            let below = depth;
            push(&mut stack, &mut depth, index + 1, limit);
            push(&mut stack, &mut depth, node.first, limit);
            // Nearer child on top.
            if depth == below + 2 && stack[below].1 < stack[below + 1].1 {
                stack.swap(below, below + 1);
            }
        }
    }
}

fn sort_along(items: &mut [u32], boxes: &[Aabb], axis: usize) {
    let center = |item: u32| boxes[item as usize].low[axis] + boxes[item as usize].high[axis];
    // Ties by index make the order deterministic.
    items.sort_unstable_by(|a, b| center(*a).total_cmp(&center(*b)).then(a.cmp(b)));
}
