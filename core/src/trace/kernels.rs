//! The choice of the kernel that an instruction set has.

use super::boxes::{KernelWork, ScalarBoxes};
#[cfg(target_arch = "x86_64")]
use super::boxes_x86::{Avx2Boxes, Sse2Boxes};
use crate::isa::Isa;

/// Does work with the kernel of an instruction set, which this CPU must have.
pub(super) fn run_with_kernel<Input>(isa: Isa, input: &Input, work: &mut impl KernelWork<Input>) {
    const LACKING: &str = "instruction sets are chosen among those that the CPU has";
    match isa {
        Isa::Scalar => work.run(input, ScalarBoxes),
        #[cfg(target_arch = "x86_64")]
        Isa::Sse2 => work.run(input, Sse2Boxes::new()),
        #[cfg(target_arch = "x86_64")]
        Isa::Avx2 => Avx2Boxes::detect().expect(LACKING).run(input, work),
        #[cfg(not(target_arch = "x86_64"))]
        Isa::Sse2 | Isa::Avx2 => panic!("{LACKING}"),
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use rtfarm_oracle::random::Random;

    use super::*;
    use crate::{
        prepared::node::{Child, Frame, Node},
        trace::boxes::{BoxKernel, BoxRay},
    };

    /// Nodes with boxes of all kinds: thick, flat, touching, far away, unused.
    fn random_node(random: &mut Random) -> Node {
        let mut node = Node::EMPTY;
        for child in 0..8 {
            if random.below(6) == 0 {
                continue; // It stays unused.
            }
            for axis in 0..3 {
                let low = grid_or_any(random);
                let thin = [0.0, f64::from(f32::EPSILON), 0.25];
                let thickness = thin.get(random.below(8)).copied().unwrap_or(1.0);
                node.planes[axis][child] = low as f32;
                node.planes[axis + 3][child] = (low + thickness) as f32;
            }
            node.children[child] = Child::leaf(child, 1);
        }
        node
    }

    /// A number among few, so that rays start on planes and graze edges, or any number.
    fn grid_or_any(random: &mut Random) -> f64 {
        match random.below(3) {
            0 => random.between(-1.0, 1.0),
            _ => random.below(9) as f64 / 4.0 - 1.0,
        }
    }

    /// Rays from everywhere, of any reach: most towards the boxes, some along axes and planes, some
    /// from afar, some that stand still.
    fn random_ray(random: &mut Random) -> BoxRay {
        let mut point = || DVec3::from_array([(); 3].map(|()| grid_or_any(random)));
        let (mut origin, target) = (point(), point());
        let mut direction = target - origin;
        match random.below(8) {
            0 => origin -= 1e9 * direction,
            1 => direction.x = 0.0,
            2 => (direction.y, direction.z) = (-0.0, 0.0),
            _ => {}
        }
        let length = direction.length();
        let direction = if length > 0.0 { direction / length } else { direction };
        let reach = [f64::INFINITY, 0.5, 3.0, f64::MIN_POSITIVE][random.below(4)];
        BoxRay::new(origin, direction, reach, &Frame { origin: [0.0; 3], scale: 1.0 })
    }

    /// What a kernel finds in a node: the mask, and the bits of the distances of what is met.
    type Found = (u32, [u32; 8]);

    impl KernelWork<(Node, BoxRay)> for Option<Found> {
        fn run(&mut self, (node, ray): &(Node, BoxRay), kernel: impl BoxKernel) {
            let (distances, mask) = kernel.test(node, ray);
            let mut bits = distances.map(f32::to_bits);
            for (child, bits) in bits.iter_mut().enumerate() {
                *bits *= mask >> child & 1;
            }
            *self = Some((mask, bits));
        }
    }

    #[test]
    fn every_kernel_meets_the_same_boxes_at_the_same_distances() {
        let random = &mut Random::new(17);
        let mut met = 0;
        for _ in 0..20_000 {
            let input = (random_node(random), random_ray(random));
            let find = |isa| {
                let mut found = None;
                run_with_kernel(isa, &input, &mut found);
                found.expect("the kernel ran")
            };
            let scalar = find(Isa::Scalar);
            met += scalar.0.count_ones();
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_supported()) {
                assert_eq!(find(isa), scalar, "{isa}: {input:?}");
            }
        }
        assert!(met > 2_000, "{met} of 160,000 boxes are met");
    }
}
