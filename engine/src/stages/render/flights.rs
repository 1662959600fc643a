//! Pipelined rendering: the device draws ahead of the host.

use super::{
    CameraRows, FrameShape, RenderOptions, RenderOutput, Renderer, camera_rows,
    planned::{Destination, pictures_per_batch},
    range::check,
};
use crate::{Error, Result, gpu::Arena, types::Camera};
use std::{collections::VecDeque, ops::Range};

struct Flight {
    cameras: Range<usize>,
    shape: FrameShape,
    destination: Destination,
}

impl Renderer {
    /// Renders each camera, passing images to `done` in order.
    ///
    /// # Errors
    /// As [`Renderer::render`], and the first error of `done`.
    pub fn render_each(
        &mut self,
        cameras: &[Camera],
        options: &RenderOptions,
        mut done: impl FnMut(usize, RenderOutput) -> Result<()>,
    ) -> Result<()> {
        check(cameras, options)?;
        let _claim = self.claim();
        let rows: Vec<CameraRows> = cameras.iter().map(camera_rows).collect();
        let result = self.fly(&self.groups(cameras), &rows, options, &mut done);
        self.settle().and(result)
    }

    fn groups(&self, cameras: &[Camera]) -> Vec<(Range<usize>, FrameShape)> {
        let mut groups: Vec<(Range<usize>, FrameShape)> = Vec::new();
        for (i, camera) in cameras.iter().enumerate() {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let most = pictures_per_batch(self.batch_size, self.gaussians(), [width, height]);
            match groups.last_mut() {
                Some((range, shape)) if (shape.width, shape.height) == (width, height) && shape.cameras < most => {
                    range.end += 1;
                    shape.cameras += 1;
                }
                _ => groups.push((i..i + 1, FrameShape { cameras: 1, width, height })),
            }
        }
        groups
    }

    fn fly(
        &mut self,
        groups: &[(Range<usize>, FrameShape)],
        rows: &[CameraRows],
        options: &RenderOptions,
        done: &mut dyn FnMut(usize, RenderOutput) -> Result<()>,
    ) -> Result<()> {
        let mut flights = VecDeque::new();
        for (turn, (cameras, shape)) in groups.iter().enumerate() {
            if flights.len() == Arena::LANES {
                self.land(&mut flights, rows, options, done)?;
            }
            let destination = Destination::Host(turn % Arena::LANES);
            let flight = Flight { cameras: cameras.clone(), shape: *shape, destination };
            match self.start(&flight, rows, options) {
                Ok(()) => flights.push_back(flight),
                Err(Error::Memory { .. }) => {
                    while !flights.is_empty() {
                        self.land(&mut flights, rows, options, done)?;
                    }
                    self.render_smaller(flight, rows, options, done)?;
                }
                Err(error) => return Err(error),
            }
        }
        while !flights.is_empty() {
            self.land(&mut flights, rows, options, done)?;
        }
        Ok(())
    }

    fn start(&mut self, flight: &Flight, rows: &[CameraRows], options: &RenderOptions) -> Result<()> {
        let plan = self.plan(flight.shape, options, flight.destination)?;
        plan.run.write(plan.cameras, &rows[flight.cameras.clone()])?;
        plan.run.start()
    }

    fn land(
        &mut self,
        flights: &mut VecDeque<Flight>,
        rows: &[CameraRows],
        options: &RenderOptions,
        done: &mut dyn FnMut(usize, RenderOutput) -> Result<()>,
    ) -> Result<()> {
        let Some(flight) = flights.pop_front() else { return Ok(()) };
        match self.finish(&flight, rows, options) {
            Ok(frames) => flight.cameras.zip(frames).try_for_each(|(i, frame)| done(i, frame)),
            // The others hold memory, too.
            Err(Error::Memory { .. }) => std::iter::once(flight)
                .chain(flights.drain(..))
                .try_for_each(|flight| self.render_smaller(flight, rows, options, done)),
            Err(error) => Err(error),
        }
    }

    fn finish(&mut self, flight: &Flight, rows: &[CameraRows], options: &RenderOptions) -> Result<Vec<RenderOutput>> {
        let Flight { cameras, shape, destination } = flight;
        let plan = self.plan(*shape, options, *destination)?;
        plan.run.finish()?;
        let needed = plan.outputs.needed(&plan.run)?;
        self.intersections = needed;
        match self.plans.fitting(needed)? {
            Some(plan) => plan.read(),
            None => self.render_batch(&rows[cameras.clone()], (shape.width, shape.height), options, *destination),
        }
    }

    /// Renders unpipelined, in smaller batches.
    fn render_smaller(
        &mut self,
        Flight { cameras, shape, .. }: Flight,
        rows: &[CameraRows],
        options: &RenderOptions,
        done: &mut dyn FnMut(usize, RenderOutput) -> Result<()>,
    ) -> Result<()> {
        self.start_over()?;
        let size = (shape.width, shape.height);
        let frames = self.render_alike(&rows[cameras.clone()], size, options, Destination::Host(0))?;
        cameras.zip(frames).try_for_each(|(i, frame)| done(i, frame))
    }
}
