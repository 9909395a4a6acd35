//! Every message of the fuzz corpus, and messages with bytes changed, through what the fuzz target
//! checks.

use std::{fs, path::Path};

#[expect(clippy::needless_pass_by_value, reason = "a message goes with its check")]
#[path = "../../../fuzz/wire.rs"]
mod targets;

fn corpus() -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus/wire");
    let entries = fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    entries.map(|entry| fs::read(entry.unwrap().path()).unwrap()).collect()
}

#[test]
fn messages_hold() {
    assert!(!corpus().is_empty());
    for message in corpus() {
        targets::message(&message);
    }
}

#[test]
fn messages_with_any_byte_changed_hold() {
    for message in corpus() {
        for place in 0..message.len() {
            targets::message(&message[..place]);
            for value in 0..=u8::MAX {
                let mut changed = message.clone();
                changed[place] = value;
                targets::message(&changed);
            }
        }
    }
}
