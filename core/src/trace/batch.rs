//! Batches of rays through the hierarchy: the nearest face, or what reaches the other end.
//!
//! Boxes are filtered in f32, faces decided in f64. The nearest hit is the smallest (t, rank), so
//! it depends neither on the tree nor on the instruction set.

use std::ops::ControlFlow;

use super::{
    box_ray::BoxRay,
    boxes::{BoxKernel, KernelWork},
    hit::{
        Nearest, between, is_between, is_quadrangle_between, take_crossing, take_quadrangle,
        take_sphere,
    },
    kernels::run_with_kernel,
    lanes::{CLASSES, MOST_RAYS},
    packet::{Meeting, Packet, PacketStack, visit_packet},
    ray::{Hit, Ray, Shear},
    solid::Scratch,
    traversal::{Stack, Step, visit},
};
use crate::{
    isa::Isa,
    prepared::{
        face::Face,
        layout::View,
        node::Frame,
        record::{Item, LightRecord, Surface},
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

/// Fewer rays of a class than this are traced alone.
const FEWEST_RAYS: usize = 8;

/// The places of rays that are traced in their own order.
const IN_ORDER: [u16; RAYS_A_REPORT] = {
    let mut places = [0; RAYS_A_REPORT];
    let mut place = 0;
    while place < RAYS_A_REPORT {
        places[place] = place as u16;
        place += 1;
    }
    places
};

/// Rays in the order in which they are traced: those of each class together, and at the end those
/// that are in no packet.
struct Order {
    /// The places of the rays.
    places: [u16; RAYS_A_REPORT],
    /// The end of the run of each class.
    ends: [u16; CLASSES + 1],
}

impl Order {
    #[inline(always)]
    fn new(kernel: impl BoxKernel, rays: &[Ray], frame: &Frame) -> Self {
        let mut classes = [0; RAYS_A_REPORT];
        for (classes, rays) in classes.as_chunks_mut().0.iter_mut().zip(rays.chunks(4)) {
            let mut four = [&rays[0]; 4];
            four.iter_mut().zip(rays).for_each(|(of_lane, ray)| *of_lane = ray);
            *classes = kernel.classify(four, frame);
        }
        let classes = &classes[..rays.len()];
        let differences = classes.iter().fold(0, |all, class| all | (class ^ classes[0]));
        if differences == 0 {
            let mut ends = [0; CLASSES + 1];
            ends[classes[0] as usize..].fill(rays.len() as u16);
            return Self { places: IN_ORDER, ends };
        }
        let mut ends = [0; CLASSES + 1];
        for &class in classes {
            ends[class as usize] += 1;
        }
        let mut end = 0;
        for count in &mut ends {
            (*count, end) = (end, end + *count);
        }
        let mut places = [0; RAYS_A_REPORT];
        for (place, &class) in (0..rays.len() as u16).zip(classes) {
            let end = &mut ends[class as usize];
            places[usize::from(*end)] = place;
            *end += 1;
        }
        Self { places, ends }
    }

    /// The rays in packets of one class, and whether they go together.
    fn packets(&self) -> impl Iterator<Item = (&[u16], bool)> {
        let firsts = std::iter::once(0).chain(self.ends);
        firsts.zip(self.ends).enumerate().flat_map(|(class, (first, end))| {
            let run = &self.places[usize::from(first)..usize::from(end)];
            let is_class = class < CLASSES;
            run.chunks(MOST_RAYS).map(move |run| (run, is_class && run.len() >= FEWEST_RAYS))
        })
    }
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
        let (mut packet, mut packet_stack) = (Packet::new(), PacketStack::default());
        for rays in self.rays.chunks(RAYS_A_REPORT) {
            if (self.on_progress)().is_break() {
                return;
            }
            let first = self.hits.len();
            self.hits.extend(rays.iter().map(|ray| Hit::none(ray.reach)));
            let hits = &mut self.hits[first..];
            for (members, go_together) in Order::new(kernel, rays, &view.header.frame).packets() {
                if !go_together {
                    for &member in members {
                        let ray = &rays[usize::from(member)];
                        let mut nearest = Nearest::new(ray);
                        visit(kernel, view, ray, &mut stack, |item, box_ray| {
                            if nearest.meet(view, kernel, box_ray, item, &mut scratch) {
                                Step::On(nearest.hit.t)
                            } else {
                                Step::Past
                            }
                        });
                        hits[usize::from(member)] = nearest.hit;
                    }
                    continue;
                }
                packet.fill(kernel, &view.header.frame, rays, members);
                let stacks = (&mut packet_stack, &mut stack);
                let scratch = &mut scratch;
                let mut meeting = NearestOfPacket { view, kernel, rays, members, hits, scratch };
                visit_packet(kernel, view, &mut packet, stacks, &mut meeting);
            }
        }
    }
}

/// The search for the nearest faces along the rays of a packet.
struct NearestOfPacket<'a, K> {
    view: &'a View<'a>,
    kernel: K,
    rays: &'a [Ray],
    members: &'a [u16],
    hits: &'a mut [Hit],
    scratch: &'a mut Scratch,
}

impl<K: BoxKernel> Meeting for NearestOfPacket<'_, K> {
    #[inline(always)]
    fn cross(&mut self, place: usize, item: Item, t: f64) -> Step {
        let member = usize::from(self.members[place]);
        let hit = &mut self.hits[member];
        if take_crossing(self.view, &self.rays[member], item, t, hit) {
            Step::On(hit.t)
        } else {
            Step::Past
        }
    }

    #[inline(always)]
    fn is_plain(&self, _item: Item) -> bool {
        true
    }

    #[inline(always)]
    fn cross_sphere(&mut self, place: usize, item: Item, ends: [f64; 2]) -> Step {
        let hit = &mut self.hits[usize::from(self.members[place])];
        if take_sphere(self.view, item, ends, hit) { Step::On(hit.t) } else { Step::Past }
    }

    #[inline(always)]
    fn cross_quadrangle(&mut self, place: usize, item: Item) -> Step {
        let member = usize::from(self.members[place]);
        let hit = &mut self.hits[member];
        if take_quadrangle(self.view, &self.rays[member], item, hit) {
            Step::On(hit.t)
        } else {
            Step::Past
        }
    }

    #[inline(always)]
    fn ask(&mut self, place: usize, item: Item, shear: &Shear, box_ray: &BoxRay) -> Step {
        let member = usize::from(self.members[place]);
        let hit = &mut self.hits[member];
        let mut nearest = Nearest { ray: &self.rays[member], shear: *shear, hit: *hit };
        if nearest.meet(self.view, self.kernel, box_ray, item, self.scratch) {
            *hit = nearest.hit;
            Step::On(hit.t)
        } else {
            Step::Past
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
        let (mut packet, mut packet_stack) = (Packet::new(), PacketStack::default());
        for rays in self.rays.chunks(RAYS_A_REPORT) {
            if (self.on_progress)().is_break() {
                return;
            }
            let first = self.shares.len();
            self.shares.resize(first + rays.len(), 1.0);
            let shares = &mut self.shares[first..];
            for (members, go_together) in Order::new(kernel, rays, &view.header.frame).packets() {
                let (scratch, ending_on) = (&mut scratch, self.ending_on);
                let mut meeting =
                    BlockedOfPacket { view, kernel, rays, members, ending_on, shares, scratch };
                if go_together {
                    packet.fill(kernel, &view.header.frame, rays, members);
                    let stacks = (&mut packet_stack, &mut stack);
                    visit_packet(kernel, view, &mut packet, stacks, &mut meeting);
                    continue;
                }
                for (place, &member) in members.iter().enumerate() {
                    let ray = &rays[usize::from(member)];
                    let shear = Shear::new(ray.origin, ray.direction);
                    visit(kernel, view, ray, &mut stack, |item, box_ray| {
                        meeting.ask(place, item, &shear, box_ray)
                    });
                }
            }
        }
    }
}

/// The search for anything in the way of the rays of a packet.
struct BlockedOfPacket<'a, K> {
    view: &'a View<'a>,
    kernel: K,
    rays: &'a [Ray],
    members: &'a [u16],
    ending_on: &'a [Surface],
    shares: &'a mut [f64],
    scratch: &'a mut Scratch,
}

impl<K: BoxKernel> Meeting for BlockedOfPacket<'_, K> {
    #[inline(always)]
    fn cross(&mut self, place: usize, item: Item, t: f64) -> Step {
        let member = usize::from(self.members[place]);
        if is_between(self.view, &self.rays[member], self.ending_on, item, t) {
            self.shares[member] = 0.0;
            return Step::Enough;
        }
        Step::Past
    }

    #[inline(always)]
    fn is_plain(&self, item: Item) -> bool {
        self.ending_on.is_empty() || !self.ending_on.contains(&Face::whole(item).surface(self.view))
    }

    #[inline(always)]
    fn cross_sphere(&mut self, place: usize, _item: Item, ends: [f64; 2]) -> Step {
        let member = usize::from(self.members[place]);
        if ends.iter().any(|&t| t > 0.0 && t < self.rays[member].reach) {
            self.shares[member] = 0.0;
            return Step::Enough;
        }
        Step::Past
    }

    #[inline(always)]
    fn cross_quadrangle(&mut self, place: usize, item: Item) -> Step {
        let member = usize::from(self.members[place]);
        if is_quadrangle_between(self.view, &self.rays[member], item) {
            self.shares[member] = 0.0;
            return Step::Enough;
        }
        Step::Past
    }

    #[inline(always)]
    fn ask(&mut self, place: usize, item: Item, shear: &Shear, box_ray: &BoxRay) -> Step {
        let member = usize::from(self.members[place]);
        let share = &mut self.shares[member];
        let aim = (&self.rays[member], shear, box_ray, self.ending_on);
        between(self.view, self.kernel, aim, item, self.scratch, |_, _| {
            *share = 0.0;
            true
        });
        if *share == 0.0 { Step::Enough } else { Step::Past }
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
                    if is_blocked { Step::Enough } else { Step::Past }
                });
                // In an order that does not depend on the tree, for products round.
                crossed.sort_unstable_by_key(|&(rank, _)| rank);
                let share = crossed.iter().fold(1.0, |product, (_, share)| product * share);
                self.shares.push(if is_blocked { 0.0 } else { share });
            }
        }
    }
}
