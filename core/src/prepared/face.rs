//! What stands at a hit, and all that can be asked of it.

use glam::DVec3;

use super::{
    layout::View,
    record::{Item, Kind, LeafRecord, MaterialRecord, PlaneIndex, SolidRecord, Surface},
};
use crate::exact::float::power_of_two_below_inverse;

/// One of the faces of a constructive solid: which leaf of the solid, and which face of the leaf.
/// Parts are ranked in this order too. What is no solid has one part, [`Part::WHOLE`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Part(u32);

impl Part {
    /// The only part of what is no solid.
    pub(crate) const WHOLE: Self = Self(0);

    /// Faces that are counted for each leaf; a sphere uses the first.
    pub(crate) const FACES: u32 = 6;

    #[inline(always)]
    pub(crate) fn new(leaf: u32, face: u32) -> Self {
        Self(Self::FACES * leaf + face)
    }

    /// The part of a solid that has a rank; `None` where another item has it.
    pub(crate) fn with_rank(solid: &SolidRecord, rank: u32) -> Option<Self> {
        let part = rank.checked_sub(solid.rank)?;
        (part as usize / (Self::FACES as usize) < solid.leaves().len()).then_some(Self(part))
    }

    /// Its rank, if it belongs to `solid`.
    #[inline(always)]
    pub(crate) fn rank(self, solid: &SolidRecord) -> u32 {
        solid.rank + self.0
    }

    /// The leaf, counted from the solid's first.
    #[inline(always)]
    pub(crate) fn leaf(self) -> usize {
        (self.0 / Self::FACES) as usize
    }

    /// The face of that leaf.
    #[inline(always)]
    pub(crate) fn face(self) -> usize {
        (self.0 % Self::FACES) as usize
    }

    /// The leaf's record.
    #[inline(always)]
    pub(crate) fn leaf_of<'a>(self, view: &View<'a>, solid: &SolidRecord) -> &'a LeafRecord {
        &view.solid_leaves(solid)[self.leaf()]
    }
}

/// What stands at a hit: an item and, of a solid, which part of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Face {
    pub(crate) item: Item,
    pub(crate) part: Part,
}

impl Face {
    /// Nothing is hit.
    pub(crate) const NONE: Self = Self::whole(Item::NONE);

    /// An item that is no solid.
    #[inline(always)]
    pub(crate) const fn whole(item: Item) -> Self {
        Self { item, part: Part::WHOLE }
    }

    /// Its place among all faces; `None` for the empty face.
    pub(crate) fn rank(self, view: &View<'_>) -> Option<u32> {
        let index = self.item.index();
        Some(match self.item.kind()? {
            Kind::Triangle | Kind::Coplanar => view.faces[index].rank(),
            Kind::Quadrangle => view.quadrangles[index].rank,
            Kind::Sphere => view.spheres[index].rank,
            Kind::Solid => self.part.rank(&view.solids[index]),
        })
    }

    /// The surface that it belongs to.
    #[inline]
    pub(crate) fn surface(self, view: &View<'_>) -> Surface {
        let index = self.item.index();
        match self.item.kind() {
            Some(Kind::Triangle) => Surface(view.faces[index].rank()),
            Some(Kind::Coplanar) => view.coat(&view.faces[index]).plane.surface(),
            Some(Kind::Quadrangle) => view.quadrangles[index].plane.surface(),
            Some(Kind::Sphere) => Surface(view.spheres[index].surface),
            Some(Kind::Solid) => {
                let leaf = self.part.leaf_of(view, &view.solids[index]);
                leaf.surface(self.part.face())
            }
            None => Surface::NONE,
        }
    }

    /// Its material.
    #[inline]
    pub(crate) fn material<'a>(self, view: &View<'a>) -> &'a MaterialRecord {
        &view.materials[self.material_index(view) as usize]
    }

    /// Its material's place among all materials.
    #[inline]
    pub(crate) fn material_index(self, view: &View<'_>) -> u32 {
        let index = self.item.index();
        match self.item.kind() {
            Some(Kind::Triangle) => view.faces[index].material(),
            Some(Kind::Coplanar) => view.coat(&view.faces[index]).material,
            Some(Kind::Quadrangle) => view.quadrangles[index].material,
            Some(Kind::Sphere) => view.spheres[index].material,
            Some(Kind::Solid) => self.part.leaf_of(view, &view.solids[index]).material,
            None => 0,
        }
    }

    /// The unit normal towards its front at a position on it.
    #[inline]
    pub(crate) fn normal(self, view: &View<'_>, position: DVec3) -> DVec3 {
        let of_plane =
            |plane: PlaneIndex| DVec3::from_array(view.planes[plane.index()].normal) * plane.sign();
        let of_sphere = |center: [f64; 3]| {
            let outward = position - DVec3::from_array(center);
            outward / outward.length()
        };
        let index = self.item.index();
        match self.item.kind().expect("a checked item") {
            Kind::Triangle => {
                let corners = view.corners(&view.faces[index].vertices);
                triangle_normal(corners.map(DVec3::from_array))
            }
            Kind::Coplanar => of_plane(view.coat(&view.faces[index]).plane),
            Kind::Quadrangle => of_plane(view.quadrangles[index].plane),
            Kind::Sphere => of_sphere(view.spheres[index].center),
            Kind::Solid => {
                let leaf = self.part.leaf_of(view, &view.solids[index]);
                let outward = if leaf.is_sphere() {
                    of_sphere(leaf.center)
                } else {
                    of_plane(leaf.planes[self.part.face()])
                };
                if leaf.is_reversed == 1 { -outward } else { outward }
            }
        }
    }

    /// A point of its plane and a unit normal, to either side, the same for all faces of a surface;
    /// `None` where it is round.
    pub(crate) fn plane(self, view: &View<'_>) -> Option<(DVec3, DVec3)> {
        let of_plane = |plane: PlaneIndex| {
            let record = &view.planes[plane.index()];
            Some((DVec3::from_array(record.point), DVec3::from_array(record.normal)))
        };
        let index = self.item.index();
        match self.item.kind()? {
            Kind::Triangle => {
                let point = self.polygon(view)?.corners()[0];
                Some((point, self.normal(view, point)))
            }
            Kind::Coplanar => of_plane(view.coat(&view.faces[index]).plane),
            Kind::Quadrangle => of_plane(view.quadrangles[index].plane),
            Kind::Sphere => None,
            Kind::Solid => {
                let leaf = self.part.leaf_of(view, &view.solids[index]);
                if leaf.is_sphere() { None } else { of_plane(leaf.planes[self.part.face()]) }
            }
        }
    }

    /// Whether it lies on a sphere.
    #[inline]
    pub(crate) fn is_round(self, view: &View<'_>) -> bool {
        match self.item.kind() {
            Some(Kind::Sphere) => true,
            Some(Kind::Solid) => {
                self.part.leaf_of(view, &view.solids[self.item.index()]).is_sphere()
            }
            _ => false,
        }
    }

    /// By how much a step along it turns its `normal`, per unit of the step: 0 on a flat face,
    /// below 0 on a sphere that is seen from within.
    #[inline]
    pub(crate) fn curvature(self, view: &View<'_>, position: DVec3, normal: DVec3) -> f64 {
        let index = self.item.index();
        let center = match self.item.kind() {
            Some(Kind::Sphere) => view.spheres[index].center,
            Some(Kind::Solid) => {
                let leaf = self.part.leaf_of(view, &view.solids[index]);
                if !leaf.is_sphere() {
                    return 0.0;
                }
                leaf.center
            }
            _ => return 0.0,
        };
        let from_center = position - DVec3::from_array(center);
        normal.dot(from_center) / from_center.length_squared()
    }

    /// The corners of a triangle or a quadrangle, in vertex order; `None` for all others.
    pub(crate) fn polygon(self, view: &View<'_>) -> Option<Polygon> {
        let index = self.item.index();
        match self.item.kind()? {
            Kind::Triangle | Kind::Coplanar => {
                Some(Polygon::new(view, &view.faces[index].vertices))
            }
            Kind::Quadrangle => Some(Polygon::new(view, &view.quadrangles[index].vertices)),
            Kind::Sphere | Kind::Solid => None,
        }
    }
}

/// Three corners or four.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Polygon {
    corners: [DVec3; 4],
    count: usize,
}

impl Polygon {
    fn new(view: &View<'_>, vertices: &[u32]) -> Self {
        let mut corners = [DVec3::ZERO; 4];
        for (corner, &vertex) in corners.iter_mut().zip(vertices) {
            *corner = DVec3::from_array(view.vertex(vertex));
        }
        Self { corners, count: vertices.len() }
    }

    /// The same seen from `origin`.
    pub(crate) fn relative_to(mut self, origin: DVec3) -> Self {
        self.corners.iter_mut().for_each(|corner| *corner -= origin);
        self
    }

    pub(crate) fn corners(&self) -> &[DVec3] {
        &self.corners[..self.count]
    }
}

/// The unit normal towards the side that sees the corners counter-clockwise. Edges are first
/// scaled by a power of two, so that no triangle is too small for its area to be a number.
pub(crate) fn triangle_normal([a, b, c]: [DVec3; 3]) -> DVec3 {
    let (u, v) = (b - a, c - a);
    let u = u * power_of_two_below_inverse(u.abs().max_element());
    let v = v * power_of_two_below_inverse(v.abs().max_element());
    let normal = u.cross(v);
    normal / normal.length()
}
