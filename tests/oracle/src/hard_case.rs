//! The hard cases by name, how many random rays their tests take, which, and how tests tell what
//! they measured.

use std::{env, fmt::Display};

use crate::random::Random;

/// What is hard for a tracer. The number of a case is its row in `docs/hard-cases.md`; it stands
/// here and nowhere else.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HardCase {
    /// Rays at the edges that faces share.
    SharedEdge = 1,
    /// Rays at the vertices that faces share.
    SharedVertex = 2,
    /// Crossings of closed surfaces, of which none may be counted twice.
    CountedTwice = 3,
    /// A mesh far from the scene's origin.
    FarMesh = 4,
    /// A whole scene far from the origin, its eye too.
    FarScene = 5,
    /// A scene scaled by powers of two.
    ScaledByPowersOfTwo = 6,
    /// Scenes scaled so far that squares of their numbers underflow or overflow.
    TinyAndHugeScenes = 7,
    /// A skinny triangle that rays graze.
    GrazedSkinnyTriangle = 8,
    /// Triangles of an extreme aspect.
    Sliver = 9,
    /// A triangle with its vertices in a line.
    TriangleWithoutArea = 10,
    /// A triangle of three equal vertices.
    TriangleOfOnePoint = 11,
    /// A huge triangle beside small ones.
    HugeTriangle = 12,
    /// A small sphere seen from afar.
    FarSphere = 13,
    /// A huge sphere seen from just above it.
    HugeSphere = 14,
    /// Rays that nearly touch a sphere.
    TangentRay = 15,
    /// Rays that start inside a sphere.
    InsideSphere = 16,
    /// Rays that leave a sphere outwards.
    LeavingSphereOutward = 17,
    /// Rays that leave a sphere inwards.
    LeavingSphereInward = 18,
    /// Spheres far smaller than a pixel.
    SubpixelSphere = 19,
    /// A radius that no sphere has.
    WrongRadius = 20,
    /// Rays along the axes that start on planes of boxes.
    AxisParallelRay = 21,
    /// Directions with a zero that has a sign.
    NegativeZero = 22,
    /// Boxes without thickness.
    FlatBox = 23,
    /// Denormal coordinates and directions.
    Denormal = 24,
    /// Numbers in a scene that are not finite.
    NotFinite = 25,
    /// Rays with a direction of zero, NaN or infinity.
    WrongDirection = 26,
    /// A shadow ray that ends on the surface that the light is on.
    LightOnItsSurface = 27,
    /// A hundred thousand triangles in one place.
    ManyFacesInOnePlace = 28,
    /// Boxes with one centroid.
    EqualCentroids = 29,
    /// Boxes with centroids one ulp apart.
    CentroidsOneUlpApart = 30,
    /// A small detailed thing in a huge scene.
    TeapotInStadium = 31,
    /// Needles of quadrangles.
    Needle = 32,
    /// Quadrangles far narrower than a pixel.
    SubpixelQuadrangle = 33,
    /// Concave quadrangles.
    ConcaveQuadrangle = 34,
    /// A quadrangle with three corners in a line.
    CollinearCorners = 35,
    /// A quadrangle that crosses itself.
    SelfCrossingQuadrangle = 36,
    /// A quadrangle that is not planar.
    BentQuadrangle = 37,
    /// Edges that quadrangles share with triangles and with each other.
    MixedSharedEdge = 38,
    /// Texture coordinates, taken to a quadrangle and back.
    TextureRoundTrip = 39,
    /// Texture coordinates on the border of the image.
    TextureBorder = 40,
    /// Boxes that are sheared until their matrix is nearly singular.
    ShearedBox = 41,
    /// A box without a volume.
    BoxWithoutVolume = 42,
    /// Rays in the plane of a box's face.
    RayInFacePlane = 43,
    /// A solid less another whose faces are flush with its own.
    FlushFaces = 44,
    /// Unions, intersections and differences of a solid with itself.
    SolidWithItself = 45,
    /// The union of solids that touch.
    TouchingSolids = 46,
    /// A shell whose walls are 1e-9 apart.
    ThinShell = 47,
    /// A solid nested 1000 deep.
    DeepNesting = 48,
    /// An eye inside glass or a solid.
    EyeInside = 49,
    /// Nested and overlapping glass.
    NestedGlass = 50,
    /// Light at the critical angle of total reflection.
    CriticalAngle = 51,
    /// Light that total reflection never lets out.
    TotalReflection = 52,
    /// Glass with a ratio of refraction of exactly 1.
    RatioOfOne = 53,
    /// Parallel mirrors, down to the deepest bounce.
    ParallelMirrors = 54,
    /// A mirror that rays graze.
    GrazedMirror = 55,
    /// A light on a surface.
    LightOnSurface = 56,
    /// A light inside an opaque shell or sphere.
    LightInOpaqueSolid = 57,
    /// A light at the eye, or at the point that a ray hits.
    LightAtEyeOrHit = 58,
    /// The edge of the shadow that a sphere casts on itself.
    Terminator = 59,
    /// Parallel planes 1e-7 apart.
    NearParallelPlanes = 60,
    /// A sphere around the scene that is huge.
    HugeSky = 61,
    /// A screen with its corners in a line, or the eye in its plane.
    WrongScreen = 62,
    /// Pictures of one pixel, and of the greatest width and height.
    ExtremePictureSizes = 63,
    /// Images of one texel and of odd sizes, seen from near and afar.
    AwkwardTextures = 64,
    /// Every instruction set and number of threads.
    AnyMachine = 65,
    /// Coincident faces of different materials.
    CoincidentFaces = 66,
    /// An eye inside glass that mirrors too.
    InsideMirroringGlass = 67,
    /// Wires in a shadow, in a mirror and behind panes.
    ThinBeyond = 68,
    /// A solid far smaller than its scene.
    TinySolid = 69,
    /// A checkerboard to the horizon, whose filter errs.
    FilteredCheckerboard = 70,
    /// A label on a tilted quadrangle, coplanar only within rounding.
    LabelWithinRounding = 71,
    /// A solid of a thousand leaves, nested deep.
    LargeSolid = 72,
}

impl HardCase {
    /// Tells what was measured of this case; `tests/long-run` makes a table of these lines. `what`
    /// is what holds, and has no colon in it.
    pub fn tell(self, what: &str, measured: impl Display) {
        eprintln!("case {:02}: {what}: {measured}", self.row());
    }

    /// The row in the table, from 1.
    pub fn row(self) -> u32 {
        self as u32
    }
}

fn number(variable: &str) -> Option<u64> {
    env::var(variable).ok().map(|value| value.parse().expect("a number"))
}

/// `RTFARM_RAYS=100` makes the tests that count rays take a hundred times as many.
pub fn rays(count: usize) -> usize {
    count * number("RTFARM_RAYS").unwrap_or(1) as usize
}

/// For rays whose truth takes long: a tenth of the more that was asked for.
pub fn few_rays(count: usize) -> usize {
    count * (number("RTFARM_RAYS").unwrap_or(1) as usize).div_ceil(10)
}

/// Random numbers of a test; `RTFARM_SEED=1` makes them others.
pub fn random(stream: u64) -> Random {
    Random::new(stream + (number("RTFARM_SEED").unwrap_or(0) << 32))
}
