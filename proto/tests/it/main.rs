//! What is tested of the messages from outside, in one program.

mod generated;
mod wire;
