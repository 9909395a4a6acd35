//! The faces that may be seen in a pixel and that no sample has passed yet.

use glam::DVec3;

use super::{
    contrast::Surfel,
    outline::{Corner, Fragment, contains},
};
use crate::render::pixel::{UNSEEN, feared, missed};

/// The faces that may be seen in a pixel and that no sample has passed yet.
#[derive(Debug, Default)]
pub(in crate::render) struct UnseenFaces {
    faces: Vec<UnseenFace>,
    /// The corners of all faces.
    corners: Vec<Corner>,
    gaps: Vec<Gap>,
    /// The shares of the pixel that faces cover, away from the eye and towards it, and gaps leave,
    /// which samples have passed by now.
    passed: [f64; 2],
    /// How far, channel by channel, the colour of faces that were too many to be looked at may lie
    /// from that of the pixel; 0 where there were not too many.
    uncounted_contrast: DVec3,
}

#[derive(Debug)]
struct UnseenFace {
    /// The index of its first corner among those of all faces.
    first: usize,
    corner_count: usize,
    /// The least and the largest row, in pixels, that it may lie between.
    rows: [f64; 2],
    /// The share of the pixel that it covers, 0..=1.
    share: f64,
    is_front: bool,
    /// How far its colour may lie from that of the pixel, channel by channel.
    contrast: DVec3,
    surfel: Surfel,
}

/// What faces that were seen, and those that continue them, leave uncovered.
#[derive(Debug)]
pub(super) struct Gap {
    /// What these faces cover of the pixel.
    pub(super) covers: Vec<Vec<Corner>>,
    /// The share of the pixel that they leave, 0..=1.
    pub(super) share: f64,
    /// How far what is seen through it may lie from the colour of the pixel, channel by channel.
    pub(super) contrast: DVec3,
}

impl UnseenFaces {
    /// Faces that are too many to be looked at: they may cover any share of the pixel.
    pub(super) fn uncounted(contrast: DVec3) -> Self {
        Self { uncounted_contrast: contrast, ..Self::default() }
    }

    /// Whether nothing may hide.
    pub(in crate::render) fn is_empty(&self) -> bool {
        self.faces.is_empty() && self.gaps.is_empty() && self.uncounted_contrast == DVec3::ZERO
    }

    /// Estimates the expected square of what the mean of `count` samples lacks, channel by channel:
    /// the faces' contrast by their share of the pixel, if all samples missed them. Of a closed
    /// body only the side that faces the eye is seen, so the two sides are not added.
    pub(in crate::render) fn variance(&self, count: u32) -> DVec3 {
        let (share, lack) = self.share_and_lack();
        lack * lack * missed(share, count) + self.uncounted_variance(count)
    }

    /// The share of the pixel that all of it covers, 0..=1, and what the mean lacks if no sample
    /// meets it.
    fn share_and_lack(&self) -> (f64, DVec3) {
        let mut shares = [0.0; 2];
        let mut lacks = [DVec3::ZERO; 2];
        for face in &self.faces {
            let side = usize::from(face.is_front);
            shares[side] += face.share;
            lacks[side] += face.share * face.contrast;
        }
        let (mut share, mut lack) = (shares[0].max(shares[1]), lacks[0].max(lacks[1]));
        for gap in &self.gaps {
            share += gap.share;
            lack += gap.share * gap.contrast;
        }
        (share.min(1.0), lack / share.max(1.0))
    }

    /// The variance that what samples missed adds in the decision to stop.
    pub(in crate::render) fn feared_variance(&self, count: u32) -> DVec3 {
        let (share, lack) = self.share_and_lack();
        feared(share, lack, count) + self.uncounted_variance(count)
    }

    fn uncounted_variance(&self, count: u32) -> DVec3 {
        let n = f64::from(count);
        self.uncounted_contrast * self.uncounted_contrast * (UNSEEN / (n * n * n))
    }

    /// The share of the pixel, 0..=1, of what later samples met that the first one had missed.
    pub(in crate::render) fn passed_share(&self) -> f64 {
        self.passed[0].max(self.passed[1]).min(1.0)
    }

    /// Forgets what may hide, but not what was passed.
    pub(super) fn forget_unseen(&mut self) {
        *self = Self { passed: self.passed, ..Self::default() };
    }

    /// Takes in what else may hide in the pixel.
    pub(in crate::render) fn join(&mut self, other: Self) {
        let [a, b] = other.passed;
        self.passed = [self.passed[0] + a, self.passed[1] + b];
        let first = self.corners.len();
        self.corners.extend(other.corners);
        let moved =
            other.faces.into_iter().map(|face| UnseenFace { first: face.first + first, ..face });
        self.faces.extend(moved);
        self.gaps.extend(other.gaps);
        self.uncounted_contrast = self.uncounted_contrast.max(other.uncounted_contrast);
    }

    /// Adds the fragment of a face with these corners, which lies between these rows.
    pub(super) fn add(
        &mut self,
        fragment: &Fragment,
        corners: &[Corner],
        rows: [f64; 2],
        contrast: DVec3,
        surfel: Surfel,
    ) {
        let (first, corner_count) = (self.corners.len(), corners.len());
        self.corners.extend(corners);
        let &Fragment { share, is_front, .. } = fragment;
        self.faces.push(UnseenFace {
            first,
            corner_count,
            rows,
            share,
            is_front,
            contrast,
            surfel,
        });
    }

    /// Adds a gap.
    pub(super) fn add_gap(&mut self, gap: Gap) {
        self.gaps.push(gap);
    }

    /// Takes out the gaps that a place on the screen lies in.
    pub(super) fn remove_gaps_at(&mut self, place: [f64; 2]) {
        let passed = &mut self.passed;
        self.gaps.retain(|gap| {
            let is_covered = gap.covers.iter().any(|cover| contains(cover, place));
            if !is_covered {
                *passed = passed.map(|share| share + gap.share);
            }
            is_covered
        });
    }

    /// Takes out a face that covers a place on the screen.
    pub(super) fn remove_at(&mut self, [x, y]: [f64; 2]) -> Option<Surfel> {
        let passed = self.faces.iter().position(|face| {
            let [low, high] = face.rows;
            let corners = &self.corners[face.first..face.first + face.corner_count];
            y >= low && y <= high && contains(corners, [x, y])
        });
        passed.map(|face| {
            let UnseenFace { share, is_front, surfel, .. } = self.faces.remove(face);
            self.passed[usize::from(is_front)] += share;
            surfel
        })
    }

    /// Lowers each face's contrast to at most what `contrast` gives for it.
    pub(super) fn limit_contrasts(&mut self, contrast: impl Fn(&Surfel) -> DVec3) {
        for face in &mut self.faces {
            face.contrast = face.contrast.min(contrast(&face.surfel));
        }
    }
}
