//! Guesses at misspelt words.

/// Finds the candidate of which `word` is most likely a misspelling.
pub(super) fn suggestion<'a>(
    word: &[u8],
    candidates: impl IntoIterator<Item = &'a str>,
) -> Option<String> {
    let word = std::str::from_utf8(word).ok().filter(|word| word.len() <= 64)?;
    let lower = word.to_lowercase();
    let distance = |candidate: &str| match candidate.to_lowercase() {
        same if same == lower => 0,
        other => 1 + strsim::damerau_levenshtein(&lower, &other),
    };
    candidates
        .into_iter()
        .filter(|candidate| candidate.len() <= 64)
        .map(|candidate| (distance(candidate), candidate))
        .filter(|(distance, candidate)| {
            *distance <= 1 + lower.chars().count().max(candidate.chars().count()) / 3
        })
        .min_by_key(|&(distance, _)| distance)
        .map(|(_, candidate)| candidate.to_owned())
}
