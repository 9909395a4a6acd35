//! Batches of rays through the hierarchy: the nearest face, or what reaches the other end.
//!
//! Boxes are filtered in f32, faces decided in f64. The nearest hit is the smallest (t, rank), so
//! it depends neither on the tree nor on the instruction set.

use super::{
    boxes::{BoxKernel, ScalarBoxes},
    hit::{Nearest, between},
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

/// Finds what each ray meets first.
pub(crate) fn trace(view: &View<'_>, isa: Isa, rays: &[Ray], hits: &mut Vec<Hit>) {
    hits.clear();
    dispatch(view, isa, &mut Trace { rays, hits });
}

/// Finds which share of its light each ray, running to `light`, lets through: 0..=1.
pub(crate) fn trace_shadows(
    view: &View<'_>,
    isa: Isa,
    light: &LightRecord,
    rays: &[Ray],
    shares: &mut Vec<f64>,
) {
    shares.clear();
    let touches = view.coincident_surfaces(light);
    if view.header.features.has_clear_shadows() {
        dispatch(view, isa, &mut ClearShadows { rays, touches, shares });
    } else {
        dispatch(view, isa, &mut Shadows { rays, touches, shares });
    }
}

/// Work on a batch of rays, the same for every instruction set.
trait Batch {
    fn run<K: BoxKernel>(&mut self, view: &View<'_>);
}

/// Runs a batch compiled for an instruction set, which must be supported.
fn dispatch(view: &View<'_>, isa: Isa, batch: &mut impl Batch) {
    assert!(isa.is_supported());
    match isa {
        Isa::Scalar => batch.run::<ScalarBoxes>(view),
        #[cfg(target_arch = "x86_64")]
        Isa::Sse2 => batch.run::<crate::trace::boxes::x86::Sse2Boxes>(view),
        #[cfg(target_arch = "x86_64")]
        #[expect(unsafe_code, reason = "a function compiled for AVX2")]
        Isa::Avx2 => {
            // SAFETY: this CPU has AVX2, asserted just above.
            unsafe { run_avx2(view, batch) }
        }
        #[cfg(not(target_arch = "x86_64"))]
        Isa::Sse2 | Isa::Avx2 => unreachable!("no other machine supports them"),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn run_avx2(view: &View<'_>, batch: &mut impl Batch) {
    batch.run::<crate::trace::boxes::x86::Avx2Boxes>(view);
}

struct Trace<'a> {
    rays: &'a [Ray],
    hits: &'a mut Vec<Hit>,
}

impl Batch for Trace<'_> {
    #[inline(always)]
    fn run<K: BoxKernel>(&mut self, view: &View<'_>) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        for ray in self.rays {
            let mut nearest = Nearest::new(ray);
            visit::<K>(view, ray, &mut stack, |item| {
                nearest.meet(view, item, &mut scratch);
                Step::On(nearest.hit.t)
            });
            self.hits.push(nearest.hit);
        }
    }
}

/// Nothing lets light through: the first face decides.
struct Shadows<'a> {
    rays: &'a [Ray],
    touches: &'a [Surface],
    shares: &'a mut Vec<f64>,
}

impl Batch for Shadows<'_> {
    #[inline(always)]
    fn run<K: BoxKernel>(&mut self, view: &View<'_>) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        for ray in self.rays {
            let shear = Shear::new(ray.origin, ray.direction);
            let mut is_blocked = false;
            visit::<K>(view, ray, &mut stack, |item| {
                between(view, ray, &shear, self.touches, item, &mut scratch, |_, _| {
                    is_blocked = true;
                });
                if is_blocked { Step::Enough } else { Step::On(ray.reach) }
            });
            self.shares.push(if is_blocked { 0.0 } else { 1.0 });
        }
    }
}

/// Every face counts.
struct ClearShadows<'a> {
    rays: &'a [Ray],
    touches: &'a [Surface],
    shares: &'a mut Vec<f64>,
}

impl Batch for ClearShadows<'_> {
    #[inline(always)]
    fn run<K: BoxKernel>(&mut self, view: &View<'_>) {
        let (mut scratch, mut stack) = (Scratch::default(), Stack::default());
        let mut crossed: Vec<(u32, f64)> = Vec::new();
        for ray in self.rays {
            let shear = Shear::new(ray.origin, ray.direction);
            crossed.clear();
            let mut is_blocked = false;
            visit::<K>(view, ray, &mut stack, |item| {
                between(view, ray, &shear, self.touches, item, &mut scratch, |rank, part| {
                    let share = Face { item, part }.material(view).transmittance();
                    is_blocked |= share == 0.0;
                    crossed.push((rank, share));
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
