//! Batches of rays through the hierarchy: the nearest face, or what reaches the other end.
//!
//! Boxes are filtered in f32, faces decided in f64. The nearest hit is the smallest (t, rank), so
//! it depends neither on the tree nor on the instruction set.

use std::ops::ControlFlow;

use super::{
    box_ray::BoxRay,
    boxes::{BoxKernel, KernelWork},
    course::Crossing,
    hit::{
        Nearest, between, counts, cross_solid_together, is_between, take, take_crossing,
        take_quadrangle, take_sphere,
    },
    kernels::run_with_kernel,
    lanes::{CLASSES, GROUPS, LANES, MOST_RAYS, RayGroup, Turn, places},
    lone::{Flights, visit_alone},
    meeting::Meeting,
    packet::{Packet, PacketStack, visit_packet},
    ray::{Hit, Ray, Shear},
    solid::Scratch,
    traversal::{Stack, Step},
};
use crate::{
    isa::Isa,
    prepared::{
        face::{Face, Part},
        layout::View,
        record::{Item, Kind, Surface},
    },
};

/// Is told that rays were traced, and may stop the work.
pub(crate) type OnProgress<'a> = &'a mut dyn FnMut() -> ControlFlow<()>;

/// How many rays are traced between two reports of progress: a ray that meets a large solid takes
/// tens of microseconds.
pub(crate) const RAYS_A_REPORT: usize = 256;

/// Room to trace in, kept from batch to batch: to clear it would cost as much as some rays.
#[derive(Debug, Default)]
pub(crate) struct Room(Box<Rooms>);

#[derive(Debug, Default)]
struct Rooms {
    scratch: Scratch,
    stack: Stack,
    /// Made when first a ray goes alone.
    flights: Option<Box<Flights>>,
    packet: Packet,
    packet_stack: PacketStack,
    /// The clear faces between rays and their lights: each with its ray's place, its rank and the
    /// share of light that it lets through.
    clear: Vec<(u16, u32, f64)>,
}

/// Finds what each ray meets first.
pub(crate) fn trace(
    view: &View<'_>,
    isa: Isa,
    Room(room): &mut Room,
    rays: &[Ray],
    hits: &mut Vec<Hit>,
    on_progress: OnProgress<'_>,
) -> ControlFlow<()> {
    hits.clear();
    run_with_kernel(isa, view, &mut Trace { room, rays, hits, on_progress });
    stop_unless(hits.len() == rays.len())
}

/// Finds which share of its light each ray, running to a light on the surfaces `ending_on`, lets
/// through: 0..=1.
pub(crate) fn trace_shadows(
    view: &View<'_>,
    isa: Isa,
    Room(room): &mut Room,
    (ending_on, rays): (&[Surface], &[Ray]),
    shares: &mut Vec<f64>,
    on_progress: OnProgress<'_>,
) -> ControlFlow<()> {
    shares.clear();
    run_with_kernel(isa, view, &mut Shadows { room, rays, ending_on, shares, on_progress });
    stop_unless(shares.len() == rays.len())
}

/// The work goes on where every ray has its answer.
fn stop_unless(is_done: bool) -> ControlFlow<()> {
    if is_done { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
}

/// Fewer rays of a class than this are traced alone.
const FEWEST_RAYS: usize = 8;

/// The same where a scene has [`DEEP`] items: rays that part on their long ways gain more by turns.
const FEWEST_IN_DEPTH: usize = 24;

/// So many items make a hierarchy deep.
const DEEP: usize = 4096;

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
    fn new(kernel: impl BoxKernel, rays: &[Ray], view: &View<'_>) -> Self {
        let frame = &view.header.frame;
        let fewest = if view.faces.len() < DEEP { FEWEST_RAYS } else { FEWEST_IN_DEPTH };
        let all_of = |class: u64| {
            let mut ends = [0; CLASSES + 1];
            ends[class as usize..].fill(rays.len() as u16);
            Self { places: IN_ORDER, ends }
        };
        if rays.len() >= fewest
            && let Some(class) = kernel.common_class(rays, frame)
        {
            return all_of(class);
        }
        let mut classes = [0; RAYS_A_REPORT];
        for (classes, rays) in classes.as_chunks_mut().0.iter_mut().zip(rays.chunks(4)) {
            let mut four = [&rays[0]; 4];
            four.iter_mut().zip(rays).for_each(|(of_lane, ray)| *of_lane = ray);
            *classes = kernel.classify(four, frame);
        }
        let classes = &classes[..rays.len()];
        let differences = classes.iter().fold(0, |all, class| all | (class ^ classes[0]));
        if differences == 0 && rays.len() >= fewest {
            return all_of(classes[0]);
        }
        let mut ends = [0; CLASSES + 1];
        for &class in classes {
            ends[class as usize] += 1;
        }
        // Classes of few rays are none.
        let mut alone = [false; CLASSES + 1];
        for class in 0..CLASSES {
            if usize::from(ends[class]) < fewest {
                alone[class] = true;
                ends[CLASSES] += std::mem::take(&mut ends[class]);
            }
        }
        let mut end = 0;
        for count in &mut ends {
            (*count, end) = (end, end + *count);
        }
        let mut places = [0; RAYS_A_REPORT];
        for (place, &class) in (0..rays.len() as u16).zip(classes) {
            let class = if alone[class as usize] { CLASSES } else { class as usize };
            let end = &mut ends[class];
            places[usize::from(*end)] = place;
            *end += 1;
        }
        Self { places, ends }
    }

    /// The rays in packets of one class.
    fn packets(&self) -> impl Iterator<Item = &[u16]> {
        let firsts = std::iter::once(0).chain(self.ends);
        firsts.zip(&self.ends[..CLASSES]).flat_map(|(first, &end)| {
            self.places[usize::from(first)..usize::from(end)].chunks(MOST_RAYS)
        })
    }

    /// The rays that go alone.
    fn lone(&self) -> &[u16] {
        let [first, end] = [self.ends[CLASSES - 1], self.ends[CLASSES]].map(usize::from);
        &self.places[first..end]
    }
}

struct Trace<'a> {
    room: &'a mut Rooms,
    rays: &'a [Ray],
    hits: &'a mut Vec<Hit>,
    on_progress: OnProgress<'a>,
}

impl KernelWork<View<'_>> for Trace<'_> {
    #[inline(always)]
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let Rooms { scratch, stack, flights, packet, packet_stack, .. } = &mut *self.room;
        for rays in self.rays.chunks(RAYS_A_REPORT) {
            if (self.on_progress)().is_break() {
                return;
            }
            let first = self.hits.len();
            self.hits.extend(rays.iter().map(|ray| Hit::none(ray.reach)));
            let hits = &mut self.hits[first..];
            let order = Order::new(kernel, rays, view);
            for members in order.packets() {
                packet.fill(kernel, &view.header.frame, rays, (members, false));
                let scratch = &mut *scratch;
                let mut meeting = NearestOfPacket { view, kernel, rays, members, hits, scratch };
                visit_packet(kernel, view, packet, (packet_stack, stack), &mut meeting);
            }
            let members = order.lone();
            let mut meeting = NearestOfPacket { view, kernel, rays, members, hits, scratch };
            visit_alone(kernel, view, (rays, members), flights, &mut meeting);
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
    const ENDS: bool = false;

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
    fn cross_group(
        &mut self,
        (group, first): (&mut RayGroup, usize),
        [crossing, within]: [u64; 2],
        item: Item,
        distances: &[f64; LANES],
    ) -> u64 {
        let mut counts = 0;
        if item.kind() != Some(Kind::Triangle) {
            for lane in places(crossing) {
                if let Step::On(reach) = self.cross(first + lane, item, distances[lane % LANES]) {
                    group.reach[lane % LANES] = reach;
                    counts |= 1 << lane;
                }
            }
            return counts;
        }
        let rank = self.view.faces[item.index()].rank();
        for lane in places(within) {
            let t = distances[lane % LANES];
            let hit = &mut self.hits[usize::from(self.members[first + lane])];
            let leaves = group.leaving[lane % LANES] == rank;
            if !leaves && take(hit, item, (t, rank, Part::WHOLE)) {
                group.reach[lane % LANES] = t;
                counts |= 1 << lane;
            }
        }
        counts
    }

    #[inline(always)]
    fn wall(&self, _item: Item) -> Option<u32> {
        None
    }

    #[inline(always)]
    fn stop(&mut self, _stopped: u64) {}

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
    fn cross_quadrangle(&mut self, place: usize, item: Item, t: f64) -> Step {
        let hit = &mut self.hits[usize::from(self.members[place])];
        if take_quadrangle(self.view, item, t, hit) { Step::On(hit.t) } else { Step::Past }
    }

    #[inline(always)]
    fn cross_solid(
        &mut self,
        groups: &mut [RayGroup; GROUPS],
        turn: &Turn,
        asking: u64,
        item: Item,
    ) -> [u64; 2] {
        let Self { view, kernel, rays, members, hits, scratch } = self;
        let solid = &view.solids[item.index()];
        let mut met = 0;
        let take = |place: usize, crossing: Crossing| {
            let member = usize::from(members[place]);
            let is_met = counts(view, solid, &rays[member], crossing);
            let Crossing { t, part } = crossing;
            if is_met && take(&mut hits[member], item, (t, part.rank(solid), part)) {
                met |= 1 << place;
            }
            is_met
        };
        let skips_start = places(asking)
            .all(|place| groups[place / LANES].after[place % LANES] == Ray::NOTHING_AHEAD);
        let (rays, asking) = ((&*groups, turn), (asking, skips_start));
        let in_doubt = cross_solid_together(*kernel, (view, item), rays, asking, scratch, take);
        for place in places(met) {
            let reach = hits[usize::from(members[place])].t;
            groups[place / LANES].reach[place % LANES] = reach;
        }
        [met, in_doubt]
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

/// What lets no light through decides alone; of the faces that do each counts.
struct Shadows<'a> {
    room: &'a mut Rooms,
    rays: &'a [Ray],
    ending_on: &'a [Surface],
    shares: &'a mut Vec<f64>,
    on_progress: OnProgress<'a>,
}

impl KernelWork<View<'_>> for Shadows<'_> {
    #[inline(always)]
    fn run(&mut self, view: &View<'_>, kernel: impl BoxKernel) {
        let Rooms { scratch, stack, flights, packet, packet_stack, clear } = &mut *self.room;
        for rays in self.rays.chunks(RAYS_A_REPORT) {
            if (self.on_progress)().is_break() {
                return;
            }
            let first = self.shares.len();
            self.shares.resize(first + rays.len(), 1.0);
            let shares = &mut self.shares[first..];
            clear.clear();
            let order = Order::new(kernel, rays, view);
            let has_clear = view.header.features.has_clear_shadows();
            let shades = Shades { ending_on: self.ending_on, has_clear, shares, clear };
            let mut meeting = BlockedOfPacket { view, kernel, rays, members: &[], scratch, shades };
            for members in order.packets() {
                packet.fill(kernel, &view.header.frame, rays, (members, !has_clear));
                meeting.members = members;
                visit_packet(kernel, view, packet, (packet_stack, stack), &mut meeting);
            }
            meeting.members = order.lone();
            visit_alone(kernel, view, (rays, order.lone()), flights, &mut meeting);
            // In an order that does not depend on the tree, for products round.
            clear.sort_unstable_by_key(|&(member, rank, _)| (member, rank));
            for &(member, _, share) in clear.iter() {
                shares[usize::from(member)] *= share;
            }
        }
    }
}

/// What becomes of the light of shadow rays.
struct Shades<'a> {
    ending_on: &'a [Surface],
    /// Whether some faces let light through.
    has_clear: bool,
    shares: &'a mut [f64],
    clear: &'a mut Vec<(u16, u32, f64)>,
}

impl Shades<'_> {
    /// A face is between a ray and its light; whether nothing of it is left.
    #[inline(always)]
    fn block(&mut self, view: &View<'_>, member: u16, rank: u32, face: Face) -> bool {
        let share = if self.has_clear { face.material(view).transmittance() } else { 0.0 };
        if share == 0.0 {
            self.shares[usize::from(member)] = 0.0;
        } else {
            self.clear.push((member, rank, share));
        }
        share == 0.0
    }
}

/// The search for anything in the way of the rays of a packet.
struct BlockedOfPacket<'a, K> {
    view: &'a View<'a>,
    kernel: K,
    rays: &'a [Ray],
    members: &'a [u16],
    scratch: &'a mut Scratch,
    shades: Shades<'a>,
}

impl<K> BlockedOfPacket<'_, K> {
    /// What an item that is no solid means if it is in the way so many times.
    #[inline(always)]
    fn block(&mut self, place: usize, item: Item, times: usize) -> Step {
        let face = Face::whole(item);
        let rank = if self.shades.has_clear { face.rank(self.view).unwrap_or(0) } else { 0 };
        for _ in 0..times {
            if self.shades.block(self.view, self.members[place], rank, face) {
                return Step::Enough;
            }
        }
        Step::Past
    }
}

impl<K: BoxKernel> Meeting for BlockedOfPacket<'_, K> {
    const ENDS: bool = true;

    #[inline(always)]
    fn cross(&mut self, place: usize, item: Item, t: f64) -> Step {
        let ray = &self.rays[usize::from(self.members[place])];
        let is_between = is_between(self.view, ray, self.shades.ending_on, item, t);
        self.block(place, item, usize::from(is_between))
    }

    #[inline(always)]
    fn cross_group(
        &mut self,
        (group, first): (&mut RayGroup, usize),
        [crossing, within]: [u64; 2],
        item: Item,
        distances: &[f64; LANES],
    ) -> u64 {
        let mut counts = 0;
        if item.kind() != Some(Kind::Triangle) || self.shades.has_clear || !self.is_plain(item) {
            for lane in places(crossing) {
                let step = self.cross(first + lane, item, distances[lane % LANES]);
                counts |= u64::from(matches!(step, Step::Enough)) << lane;
            }
            return counts;
        }
        let rank = self.view.faces[item.index()].rank();
        for lane in places(within) {
            let leaves = group.leaving[lane % LANES] == rank;
            if !leaves && distances[lane % LANES] < group.reach[lane % LANES] {
                self.shades.shares[usize::from(self.members[first + lane])] = 0.0;
                counts |= 1 << lane;
            }
        }
        counts
    }

    #[inline(always)]
    fn wall(&self, item: Item) -> Option<u32> {
        let is_wall = item.kind() == Some(Kind::Triangle) && !self.shades.has_clear;
        (is_wall && self.is_plain(item)).then(|| self.view.faces[item.index()].rank())
    }

    #[inline(always)]
    fn stop(&mut self, stopped: u64) {
        for place in places(stopped) {
            self.shades.shares[usize::from(self.members[place])] = 0.0;
        }
    }

    #[inline(always)]
    fn is_plain(&self, item: Item) -> bool {
        let ending_on = self.shades.ending_on;
        ending_on.is_empty() || !ending_on.contains(&Face::whole(item).surface(self.view))
    }

    #[inline(always)]
    fn cross_sphere(&mut self, place: usize, item: Item, ends: [f64; 2]) -> Step {
        let reach = self.rays[usize::from(self.members[place])].reach;
        let inner = ends.iter().filter(|&&t| t > 0.0 && t < reach);
        self.block(place, item, inner.count())
    }

    #[inline(always)]
    fn cross_quadrangle(&mut self, place: usize, item: Item, t: f64) -> Step {
        let reach = self.rays[usize::from(self.members[place])].reach;
        self.block(place, item, usize::from(t < reach))
    }

    #[inline(always)]
    fn cross_solid(
        &mut self,
        groups: &mut [RayGroup; GROUPS],
        turn: &Turn,
        asking: u64,
        item: Item,
    ) -> [u64; 2] {
        let Self { view, kernel, rays, members, scratch, shades } = self;
        if !shades.ending_on.is_empty() {
            return [0, asking];
        }
        let solid = &view.solids[item.index()];
        let told = shades.clear.len();
        let mut met = 0;
        let take = |place: usize, Crossing { t, part }: Crossing| {
            let member = members[place];
            let is_between = t > 0.0 && t < rays[usize::from(member)].reach;
            let is_blocked =
                is_between && shades.block(view, member, part.rank(solid), Face { item, part });
            met |= u64::from(is_blocked) << place;
            is_blocked
        };
        let (rays, asking) = ((&*groups, turn), (asking, true));
        let in_doubt = cross_solid_together(*kernel, (view, item), rays, asking, scratch, take);
        if in_doubt != 0 {
            // What these were told of does not count.
            let mut at = 0;
            shades.clear.retain(|&(member, ..)| {
                at += 1;
                at <= told || !places(in_doubt).any(|place| members[place] == member)
            });
        }
        [met, in_doubt]
    }

    #[inline(always)]
    fn ask(&mut self, place: usize, item: Item, shear: &Shear, box_ray: &BoxRay) -> Step {
        let Self { view, kernel, scratch, shades, .. } = self;
        let member = self.members[place];
        let aim = (&self.rays[usize::from(member)], shear, box_ray, shades.ending_on);
        let mut is_blocked = false;
        between(view, *kernel, aim, item, scratch, |rank, part| {
            is_blocked |= shades.block(view, member, rank, Face { item, part });
            is_blocked
        });
        if is_blocked { Step::Enough } else { Step::Past }
    }
}
