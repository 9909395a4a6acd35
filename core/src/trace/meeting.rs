//! What rays that are under way tell of what they meet.

use super::{
    box_ray::BoxRay,
    lanes::{GROUPS, LANES, RayGroup, Turn},
    ray::Shear,
    traversal::Step,
};
use crate::prepared::record::Item;

/// What is done with what rays meet. A ray is told by its place among those that are under way.
pub(super) trait Meeting {
    /// Whether a ray's answer is known as soon as it has met something that counts; else it then
    /// only reaches less far.
    const ENDS: bool;

    /// The ray at a place in the packet crosses a triangle at a distance, before or behind its
    /// start.
    fn cross(&mut self, place: usize, item: Item, t: f64) -> Step;

    /// The same for rays of a group whose first one is at a place, by a mask of its lanes, and by
    /// one of those among them that do so in front of their starts and within their reach; which of
    /// them have met something that counts. Where rays reach less far then, the group knows.
    fn cross_group(
        &mut self,
        group: (&mut RayGroup, usize),
        crossing: [u64; 2],
        item: Item,
        distances: &[f64; LANES],
    ) -> u64;

    /// The surface of a triangle that ends every ray which crosses it between its ends, unless it
    /// leaves this surface. `None` where more is to be asked.
    fn wall(&self, item: Item) -> Option<u32>;

    /// The rays at these places, a bit each, certainly cross such a triangle.
    fn stop(&mut self, stopped: u64);

    /// Whether each ray meets this sphere or quadrangle as [`Meeting::cross_sphere`] and
    /// [`Meeting::cross_quadrangle`] have it; else it is asked.
    fn is_plain(&self, item: Item) -> bool;

    /// The line of a ray crosses this sphere at two distances, the nearer one first, other than its
    /// start if it leaves the sphere; infinite where there is none.
    fn cross_sphere(&mut self, place: usize, item: Item, ends: [f64; 2]) -> Step;

    /// The ray's line crosses a quadrangle that the ray does not leave, at a distance above 0.
    fn cross_quadrangle(&mut self, place: usize, item: Item, t: f64) -> Step;

    /// The rays `asking` of a packet may meet a solid: which of them have met something that
    /// counts, and which are in doubt and ask alone. Where rays reach less far then, their groups
    /// know.
    fn cross_solid(
        &mut self,
        groups: &mut [RayGroup; GROUPS],
        turn: &Turn,
        asking: u64,
        item: Item,
    ) -> [u64; 2];

    /// The ray may meet an item.
    fn ask(&mut self, place: usize, item: Item, shear: &Shear, box_ray: &BoxRay) -> Step;
}
