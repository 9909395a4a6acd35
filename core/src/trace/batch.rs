//! Batches of rays through the hierarchy: the nearest face, or what reaches the other end.
//!
//! Boxes are filtered in f32, faces decided in f64. The nearest hit is the smallest (t, rank), so
//! it depends neither on the tree nor on the instruction set.

use std::ops::ControlFlow;

use super::{
    boxes::{BoxKernel, KernelWork},
    hit::{Nearest, between},
    kernels::run_with_kernel,
    ray::{Hit, Ray, Shear},
    solid::Scratch,
    traversal::{Stack, Step, visit},
};
use crate::{
    isa::Isa,
    prepared::{
        face::Face,
        layout::View,
        record::{LightRecord, Surface},
    },
};

/// Is told that rays were traced, and may stop the work.
pub(crate) type OnProgress<'a> = &'a mut dyn FnMut() -> ControlFlow<()>;

/// How many rays are traced between two reports of progress: a ray that meets a large solid takes
/// tens of microseconds.
pub(crate) const RAYS_A_REPORT: usize = 256;

/// Finds what each ray meets first.
pub(crate) fn trace(
    view: &View<'_>,
    isa: Isa,
    rays: &[Ray],
    hits: &mut Vec<Hit>,
    on_progress: OnProgress<'_>,
) -> ControlFlow<()> {
    hits.clear();
    run_with_kernel(isa, view, &mut Trace { rays, hits, on_progress });
    stop_unless(hits.len() == rays.len())
}

/// Finds which share of its light each ray, running to `light`, lets through: 0..=1.
pub(crate) fn trace_shadows(
    view: &View<'_>,
    isa: Isa,
    light: &LightRecord,
    rays: &[Ray],
    shares: &mut Vec<f64>,
    on_progress: OnProgress<'_>,
) -> ControlFlow<()> {
    shares.clear();
    let ending_on = view.coincident_surfaces(light);
    if view.header.features.has_clear_shadows() {
        run_with_kernel(isa, view, &mut ClearShadows { rays, ending_on, shares, on_progress });
    } else {
        run_with_kernel(isa, view, &mut Shadows { rays, ending_on, shares, on_progress });
    }
    stop_unless(shares.len() == rays.len())
}

/// The work goes on where every ray has its answer.
fn stop_unless(is_done: bool) -> ControlFlow<()> {
    if is_done { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
}

struct Trace<'a> {
    rays: &'a [Ray],
    hits: &'a mut Vec<Hit>,
    on_progress: OnProgress<'a>,
}

impl KernelWork<View<'_>> for Trace<'_> {
    #[inline(always)]
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        for rays in self.rays.chunks(RAYS_A_REPORT) {
            if (self.on_progress)().is_break() {
                return;
            }
            for ray in rays {
                let mut nearest = Nearest::new(ray);
                visit(kernel, view, ray, &mut stack, |item, box_ray| {
                    nearest.meet(view, kernel, box_ray, item, &mut scratch);
                    Step::On(nearest.hit.t)
                });
                self.hits.push(nearest.hit);
            }
        }
    }
}

/// Nothing lets light through: the first face decides.
struct Shadows<'a> {
    rays: &'a [Ray],
    ending_on: &'a [Surface],
    shares: &'a mut Vec<f64>,
    on_progress: OnProgress<'a>,
}

impl KernelWork<View<'_>> for Shadows<'_> {
    #[inline(always)]
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        for rays in self.rays.chunks(RAYS_A_REPORT) {
            if (self.on_progress)().is_break() {
                return;
            }
            for ray in rays {
                let shear = Shear::new(ray.origin, ray.direction);
                let mut is_blocked = false;
                visit(kernel, view, ray, &mut stack, |item, box_ray| {
                    let aim = (ray, &shear, box_ray, self.ending_on);
                    between(view, kernel, aim, item, &mut scratch, |_, _| {
                        is_blocked = true;
                        true
                    });
                    if is_blocked { Step::Enough } else { Step::On(ray.reach) }
                });
                self.shares.push(if is_blocked { 0.0 } else { 1.0 });
            }
        }
    }
}

/// Every face counts.
struct ClearShadows<'a> {
    rays: &'a [Ray],
    ending_on: &'a [Surface],
    shares: &'a mut Vec<f64>,
    on_progress: OnProgress<'a>,
}

impl KernelWork<View<'_>> for ClearShadows<'_> {
    #[inline(always)]
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        let mut crossed: Vec<(u32, f64)> = Vec::new();
        for rays in self.rays.chunks(RAYS_A_REPORT) {
            if (self.on_progress)().is_break() {
                return;
            }
            for ray in rays {
                let shear = Shear::new(ray.origin, ray.direction);
                crossed.clear();
                let mut is_blocked = false;
                visit(kernel, view, ray, &mut stack, |item, box_ray| {
                    let aim = (ray, &shear, box_ray, self.ending_on);
                    between(view, kernel, aim, item, &mut scratch, |rank, part| {
                        let share = Face { item, part }.material(view).transmittance();
                        is_blocked |= share == 0.0;
                        crossed.push((rank, share));
                        is_blocked
                    });
                    if is_blocked { Step::Enough } else { Step::On(ray.reach) }
                });
                // In an order that does not depend on the tree, for products round.
                crossed.sort_unstable_by_key(|&(rank, _)| rank);
                let share = crossed.iter().fold(1.0, |product, (_, share)| product * share);
                self.shares.push(if is_blocked { 0.0 } else { share });
            }
        }
    }
}
