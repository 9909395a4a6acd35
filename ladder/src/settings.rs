//! The settings that a ladder has.

use rtfarm_core::{
    render::{SampleLimit, Sampling, StandardError},
    sample::MOST_SAMPLES,
};

/// The adaptive settings from coarse to fine: each asks for an error smaller by √2 than the one
/// before. Below an 8-bit step pixels may have more samples as well.
pub fn adaptive_settings() -> impl Iterator<Item = Sampling> {
    (0..=24).map(|rung: u32| {
        let halves = f64::from(1_u32 << (rung / 2));
        let half = if rung.is_multiple_of(2) { 1.0 } else { std::f64::consts::SQRT_2 };
        let error = 32.0 * StandardError::EIGHT_BIT_STEP.get() / (halves * half);
        let most = SampleLimit::DEFAULT.get() << rung.saturating_sub(10).min(8);
        Sampling::adaptive(error, most.min(MOST_SAMPLES)).expect("both are in range")
    })
}

#[cfg(test)]
mod tests {
    use rtfarm_core::render::Quality;

    use super::*;

    #[test]
    fn errors_fall_and_every_setting_can_be_asked_for() {
        let settings: Vec<Sampling> = adaptive_settings().collect();
        let errors: Vec<StandardError> = (settings.iter())
            .map(|setting| match *setting {
                Sampling::Adaptive { error, .. } => error,
                Sampling::Fixed(_) => panic!("{setting:?}"),
            })
            .collect();
        assert!(errors.is_sorted_by(|a, b| a > b), "{errors:?}");
        assert!(settings.contains(&Quality::default().sampling));
    }
}
