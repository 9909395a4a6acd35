//! Beams that flat surfaces send on: towards the lights, whose shadows they show, mirrored, and
//! straight through what does not bend. As the surface is flat such a beam comes from one point
//! too, so it is searched like that of the eye, with a screen on which pixels have the same places.
//!
//! Source: Heckbert & Hanrahan, "Beam Tracing Polygonal Objects" (1984).

use std::{iter, ops::ControlFlow};

use glam::DVec3;

use super::{
    faces::UnseenFaces,
    first_samples::FirstSample,
    frustum::FrustumSearch,
    judge::{DEPTH_RATIO, Judge, Sight},
    outline::Outline,
    screen::{Beam, Reach, Rectangle, Screen, Sheet},
};
use crate::{
    isa::Isa,
    prepared::{
        layout::View,
        record::{LightRecord, MaterialRecord, Surface},
    },
    shade::{optics::mirror, point::Interaction},
    tile::Area,
    trace::{
        batch::{Room, trace},
        ray::{Hit, Ray},
    },
};

/// The sides, in pixels, of the frame's squares that are searched in one go, and how many faces may
/// be in their beams. Where one of the last size has more nothing is looked for: a light is
/// searched for shadows in whole squares, so that a pixel finds the same in every tile.
const SQUARES: [(u32, usize); 2] = [(8, 64), (2, 48)];

/// The most faces that one pixel's beam in a mirror or behind a pane is searched for.
const MOST_FACES: usize = 64;

/// A beam goes on from so many surfaces.
const MOST_SURFACES: u32 = 4;

/// Beams that count less than this in their pixel are not followed.
const LEAST_WEIGHT: f64 = 1.0 / 16.0;

/// What the first sample of a pixel meets on its way.
#[derive(Debug, Clone, Copy)]
struct Look {
    x: u32,
    y: u32,
    first: FirstSample,
    surface: Surface,
    /// What is seen here counts so much in the pixel.
    weight: f64,
}

impl Look {
    /// Its ray from where the beam comes from.
    fn ray(&self, screen: &Screen) -> Ray {
        let direction = screen.direction(self.first.place);
        Ray {
            origin: screen.eye(),
            direction: direction / direction.length(),
            reach: f64::INFINITY,
            leaving: Surface::NONE,
            after: Ray::NOTHING_AHEAD,
        }
    }
}

/// A way on from a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    Mirrored,
    Straight,
}

/// A flat surface that pixels look at: the screen of their beams, and itself on it.
struct Stage<'s> {
    screen: &'s Screen,
    sheet: Sheet,
    surface: Surface,
    /// The square of the frame that the pixels are in.
    square: Area,
}

/// What searches a beam, what judges the faces in it, and who gets them.
pub(super) struct Tools<'t, 'a, F> {
    pub(super) frustum_search: &'t mut FrustumSearch,
    pub(super) judge: &'t mut Judge<'a>,
    pub(super) on_found: &'t mut F,
}

/// The search of beams that surfaces send on.
pub(super) struct OnwardSearch<'a> {
    view: &'a View<'a>,
    isa: Isa,
    lights: &'a [LightRecord],
    has_branches: bool,
    ray_count: u64,
    /// Counts the beams of the pixels at hand.
    beam: u32,
}

impl<'a> OnwardSearch<'a> {
    /// It is `None` where no surface sends beams on.
    pub(super) fn new(view: &'a View<'a>, flat: bool, isa: Isa) -> Option<Self> {
        let features = &view.header.features;
        let lights = if flat || features.is_lit == 0 { &[] } else { view.lights };
        let has_branches = features.has_branches();
        let goes_on = has_branches || !lights.is_empty();
        goes_on.then_some(Self { view, isa, lights, has_branches, ray_count: 0, beam: 0 })
    }

    /// The rays that it has traced.
    pub(super) fn rays(&self) -> u64 {
        self.ray_count
    }

    /// Finds what may hide in the pixels of an area in beams that surfaces send on. `look` tells
    /// what a pixel's first sample saw, if its beam is to be followed.
    pub(super) fn search(
        &mut self,
        screen: &Screen,
        area: Area,
        mut tools: Tools<'_, 'a, impl FnMut(u32, u32, UnseenFaces)>,
        look: &impl Fn(u32, u32) -> Option<FirstSample>,
    ) {
        let mut looks = Vec::new();
        for square in area.squares_of_frame(SQUARES[0].0) {
            looks.clear();
            looks.extend(square.common_pixels(area).filter_map(|(x, y)| {
                let first = look(x, y)?;
                let surface = first.hit.face.surface(self.view);
                Some(Look { x, y, first, surface, weight: 1.0 })
            }));
            self.beam = 0;
            self.follow(screen, square, &mut looks, 1, &mut tools);
        }
    }

    /// Searches the beams that go on from what pixels of a square look at, at surface number
    /// `depth` of their way.
    fn follow(
        &mut self,
        screen: &Screen,
        square: Area,
        looks: &mut [Look],
        depth: u32,
        tools: &mut Tools<'_, 'a, impl FnMut(u32, u32, UnseenFaces)>,
    ) {
        looks.sort_by_key(|look| look.surface.0);
        for run in looks.chunk_by(|a, b| a.surface == b.surface) {
            let Some((point, normal)) = run[0].first.hit.face.plane(self.view) else { continue };
            let Some(sheet) = Sheet::new(screen, point, normal) else { continue };
            let stage = Stage { screen, sheet, surface: run[0].surface, square };
            for light in self.lights {
                self.beam += 1;
                self.search_light(&stage, light, run, tools);
            }
            if !self.has_branches {
                continue;
            }
            for way in [Way::Mirrored, Way::Straight] {
                self.beam += 1;
                let next = self.go_on(screen, run, way);
                if next.is_empty() {
                    continue;
                }
                let seen = match way {
                    Way::Mirrored => screen.mirrored(&sheet),
                    Way::Straight => Some(*screen),
                };
                let Some(seen) = seen else { continue };
                self.search_way(&seen, &sheet, &next, tools);
                if depth < MOST_SURFACES {
                    let mut next = next;
                    next.retain(|look| look.first.hit.is_some());
                    self.follow(&seen, square, &mut next, depth + 1, tools);
                }
            }
        }
    }

    /// Finds the faces between a surface and a light.
    fn search_light(
        &mut self,
        stage: &Stage<'_>,
        light: &LightRecord,
        run: &[Look],
        tools: &mut Tools<'_, 'a, impl FnMut(u32, u32, UnseenFaces)>,
    ) {
        let position = DVec3::from_array(light.position);
        let on_light = self.view.coincident_surfaces(light);
        if on_light.contains(&stage.surface) || !stage.sheet.is_before(position) {
            return;
        }
        let Some(screen) = stage.screen.seen_by_light(&stage.sheet, position) else { return };
        let ends_here = |face: &Outline| {
            let surface = face.face.surface(self.view);
            surface == stage.surface || on_light.contains(&surface)
        };
        let mut blocks = vec![(stage.square, 0)];
        while let Some((block, size)) = blocks.pop() {
            let looks = || run.iter().filter(|look| block.contains(look.x, look.y));
            let Some(&(_, most)) = SQUARES.get(size) else { continue };
            if looks().next().is_none() {
                continue;
            }
            let beam = Beam::before(&stage.sheet, Rectangle::of_block(block));
            if !tools.frustum_search.collect(self.view, &screen, &beam, most) {
                if let Some(&(smaller, _)) = SQUARES.get(size + 1) {
                    blocks.extend(block.blocks(smaller).map(|block| (block, size + 1)));
                }
                continue;
            }
            let outlines = &tools.frustum_search.outlines;
            if outlines.as_slice().iter().all(ends_here) {
                continue;
            }
            for look in looks() {
                let arriving = self.light_at(stage.screen, light, look);
                if tools.judge.is_negligible(1.0, arriving) {
                    continue;
                }
                let deepest =
                    Beam::before(&stage.sheet, Rectangle::of_pixel(look.x, look.y)).deepest;
                let reach = Reach::Before(stage.sheet);
                let sight = Sight { screen: &screen, beam: self.beam, reach, weight: 1.0, deepest };
                let sample = (look.first.place, arriving);
                let unseen =
                    tools.judge.find_shadows(&sight, outlines, (look.x, look.y), sample, ends_here);
                if !unseen.is_empty() {
                    (tools.on_found)(look.x, look.y, unseen);
                }
            }
        }
    }

    /// Bounds what a light adds to what a pixel's first sample saw.
    fn light_at(&self, screen: &Screen, light: &LightRecord, look: &Look) -> DVec3 {
        let (ray, hit) = (look.ray(screen), &look.first.hit);
        let at = Interaction::new(self.view, &ray, hit);
        let MaterialRecord { color, reflect, alpha, texture, .. } = *at.material;
        let own = look.weight * (1.0 - reflect) * alpha * DVec3::from_array(color);
        let to_light = DVec3::from_array(light.position) - at.position;
        let distance = to_light.length();
        let intensity = DVec3::from_array(light.intensity);
        let arrival =
            intensity * (at.normal.dot(to_light).max(0.0) / (distance * distance * distance));
        let ambient = self.view.header.lighting.ambient();
        let other = if texture == MaterialRecord::PLAIN { own * ambient } else { DVec3::ZERO };
        (own * arrival).min((look.first.color - other).max(DVec3::ZERO))
    }

    /// What the pixels of a run look at further on.
    fn go_on(&mut self, screen: &Screen, run: &[Look], way: Way) -> Vec<Look> {
        let (mut rays, mut next) = (Vec::new(), Vec::new());
        for look in run {
            let material = look.first.hit.face.material(self.view);
            let bends = material.refract != 0.0 && material.refract != 1.0;
            let weight = look.weight
                * match way {
                    Way::Mirrored => material.reflect,
                    Way::Straight if bends => 0.0,
                    Way::Straight => material.transmittance(),
                };
            if weight < LEAST_WEIGHT {
                continue;
            }
            let ray = look.ray(screen);
            let at = Interaction::new(self.view, &ray, &look.first.hit);
            let cosine = -at.normal.dot(ray.direction);
            rays.push(match way {
                Way::Mirrored => {
                    at.leave(mirror(ray.direction, at.normal, cosine), Ray::NOTHING_AHEAD)
                }
                Way::Straight => at.leave(ray.direction, at.rank),
            });
            next.push(Look { weight, ..*look });
        }
        let mut hits = Vec::new();
        let never_stop = &mut || ControlFlow::Continue(());
        let _ = trace(self.view, self.isa, &mut Room::default(), &rays, &mut hits, never_stop);
        self.ray_count += rays.len() as u64;
        for (look, hit) in next.iter_mut().zip(hits) {
            look.first.hit = Hit { t: look.first.hit.t + hit.t, ..hit };
            look.surface = hit.face.surface(self.view);
        }
        next
    }

    /// Finds faces in a mirror or behind a pane, `sheet`, where the pixels look at these places.
    fn search_way(
        &mut self,
        screen: &Screen,
        sheet: &Sheet,
        looks: &[Look],
        tools: &mut Tools<'_, 'a, impl FnMut(u32, u32, UnseenFaces)>,
    ) {
        for look in looks {
            let (x, y, first) = (look.x, look.y, &look.first);
            let deepest = DEPTH_RATIO * first.hit.t / screen.direction(first.place).length();
            let reach = Reach::Behind(*sheet);
            let beam = Beam { block: Rectangle::of_pixel(x, y), deepest, reach };
            if !tools.frustum_search.collect(self.view, screen, &beam, MOST_FACES) {
                continue;
            }
            let sight = Sight { screen, beam: self.beam, reach, weight: look.weight, deepest };
            let outlines = &tools.frustum_search.outlines;
            let faces = outlines.by_rank();
            let faces = (outlines, &faces[..]);
            let unseen = tools.judge.find_unseen(&sight, faces, (x, y), first, iter::empty());
            if !unseen.is_empty() {
                (tools.on_found)(x, y, unseen);
            }
        }
    }
}
