//! What rendering took and how good the pixels are.

/// What rendering took and how good the pixels are.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tally {
    /// Rays traced, of all kinds.
    pub rays: u64,
    /// Camera rays among them.
    pub samples: u64,
    /// The largest sum of weights of branches that were not traced, in any sample. 0..=1.
    pub cut: f64,
    /// Pixels whose error was estimated.
    pub estimated: u64,
    /// The sum of those pixels' estimated variances, each the mean of its channels'.
    pub variance: f64,
    /// Pixels that got the most samples that they may have and are not below the wanted error.
    pub capped: u64,
}

impl Tally {
    /// Takes that of other pixels in.
    pub fn add(&mut self, other: &Self) {
        self.rays += other.rays;
        self.samples += other.samples;
        self.cut = self.cut.max(other.cut);
        self.estimated += other.estimated;
        self.variance += other.variance;
        self.capped += other.capped;
    }

    /// The estimated root-mean-square error of a channel; `None` where no pixel had enough samples.
    pub fn error(&self) -> Option<f64> {
        (self.estimated > 0).then(|| (self.variance / self.estimated as f64).sqrt())
    }
}
