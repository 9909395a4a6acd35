//! The test of a ray against a node's boxes with x86-64's instructions.

use std::arch::x86_64::{
    _CMP_LE_OQ, _mm_cmple_ps, _mm_loadu_ps, _mm_max_ps, _mm_min_ps, _mm_movemask_ps, _mm_mul_ps,
    _mm_set1_ps, _mm_storeu_ps, _mm_sub_ps, _mm256_cmp_ps, _mm256_loadu_ps, _mm256_max_ps,
    _mm256_min_ps, _mm256_movemask_ps, _mm256_mul_ps, _mm256_set1_ps, _mm256_storeu_ps,
    _mm256_sub_ps,
};

use super::boxes::{BoxKernel, BoxRay, FAR, KernelWork};
use crate::prepared::node::Node;

/// The kernel with SSE2, four boxes at a time. Every x86-64 CPU has it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sse2Boxes(());

impl Sse2Boxes {
    pub(crate) fn new() -> Self {
        Self(())
    }
}

impl BoxKernel for Sse2Boxes {
    type Plain = Self;

    #[inline(always)]
    fn plain(self) -> Self {
        self
    }

    #[inline(always)]
    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
        let mut distances = [0.0; 8];
        let mut mask = 0;
        for half in [0, 4] {
            // SAFETY: SSE2 is part of x86-64. The loads read `planes[_][half..half + 4]` and
            // the store writes `distances[half..half + 4]`, both within 8 floats.
            unsafe {
                let mut enter = _mm_set1_ps(ray.low);
                let mut leave = _mm_set1_ps(ray.high);
                for axis in 0..3 {
                    let near = _mm_loadu_ps(node.planes[ray.near[axis]].as_ptr().add(half));
                    let far = _mm_loadu_ps(node.planes[ray.far[axis]].as_ptr().add(half));
                    let inverse = _mm_set1_ps(ray.inverse[axis]);
                    let near = _mm_sub_ps(near, _mm_set1_ps(ray.near_origin[axis]));
                    let far = _mm_sub_ps(far, _mm_set1_ps(ray.far_origin[axis]));
                    enter = _mm_max_ps(_mm_mul_ps(near, inverse), enter);
                    let far = _mm_mul_ps(_mm_mul_ps(far, inverse), _mm_set1_ps(FAR));
                    leave = _mm_min_ps(far, leave);
                }
                _mm_storeu_ps(distances.as_mut_ptr().add(half), enter);
                let met = _mm_movemask_ps(_mm_cmple_ps(enter, leave));
                mask |= (met as u32) << half;
            }
        }
        (distances, mask)
    }
}

/// The kernel with AVX2, all eight boxes at once. [`Avx2Boxes::detect`] makes it on CPUs that have
/// AVX2, and nothing else does.
#[derive(Debug, Clone, Copy)]
pub(super) struct Avx2Boxes(());

impl Avx2Boxes {
    /// `None` on a CPU without AVX2.
    pub(super) fn detect() -> Option<Self> {
        std::arch::is_x86_feature_detected!("avx2").then_some(Self(()))
    }

    /// Does work that is compiled for AVX2 together with the kernel.
    pub(super) fn run<Input>(self, input: &Input, work: &mut impl KernelWork<Input>) {
        #[target_feature(enable = "avx2")]
        fn run_compiled_for_avx2<Input>(
            kernel: Avx2Boxes,
            input: &Input,
            work: &mut impl KernelWork<Input>,
        ) {
            work.run(input, kernel);
        }
        // SAFETY: a value of this type says that the CPU has AVX2.
        unsafe { run_compiled_for_avx2(self, input, work) }
    }
}

impl BoxKernel for Avx2Boxes {
    type Plain = Sse2Boxes;

    #[inline(always)]
    fn plain(self) -> Sse2Boxes {
        Sse2Boxes(())
    }

    #[inline(always)]
    fn test(self, node: &Node, ray: &BoxRay) -> ([f32; 8], u32) {
        let mut distances = [0.0; 8];
        // SAFETY: a value of this type says that the CPU has AVX2. The loads read `planes[_]` and
        // the store writes `distances`, exactly 8 floats each.
        let mask = unsafe {
            let mut enter = _mm256_set1_ps(ray.low);
            let mut leave = _mm256_set1_ps(ray.high);
            for axis in 0..3 {
                let near = _mm256_loadu_ps(node.planes[ray.near[axis]].as_ptr());
                let far = _mm256_loadu_ps(node.planes[ray.far[axis]].as_ptr());
                let inverse = _mm256_set1_ps(ray.inverse[axis]);
                let near = _mm256_sub_ps(near, _mm256_set1_ps(ray.near_origin[axis]));
                let far = _mm256_sub_ps(far, _mm256_set1_ps(ray.far_origin[axis]));
                enter = _mm256_max_ps(_mm256_mul_ps(near, inverse), enter);
                let far = _mm256_mul_ps(_mm256_mul_ps(far, inverse), _mm256_set1_ps(FAR));
                leave = _mm256_min_ps(far, leave);
            }
            _mm256_storeu_ps(distances.as_mut_ptr(), enter);
            _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave)) as u32
        };
        (distances, mask)
    }
}
