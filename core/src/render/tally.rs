//! What rendering took and how good the pixels are.

/// What rendering took and how good the pixels are.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tally {
    /// Rays traced, of all kinds.
    pub rays: u64,
    /// Camera rays among them.
    pub samples: u64,
    /// The sum over all samples of the weights of branches that were not traced but count as
    /// background: they lie deeper than [`DEEPEST`](super::DEEPEST).
    pub untraced: f64,
    /// The most of it in any sample.
    pub most_untraced: f64,
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
        self.untraced += other.untraced;
        self.most_untraced = self.most_untraced.max(other.most_untraced);
        self.estimated += other.estimated;
        self.variance += other.variance;
        self.capped += other.capped;
    }

    /// The estimated root-mean-square error of a channel; `None` where no pixel had enough samples.
    pub fn error(&self) -> Option<f64> {
        (self.estimated > 0).then(|| (self.variance / self.estimated as f64).sqrt())
    }
}
