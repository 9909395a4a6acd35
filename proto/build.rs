//! Compiles `farm.proto` without a `protoc` on the machine.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=farm.proto");
    let files = protox::compile(["farm.proto"], ["."])?;
    tonic_prost_build::configure().bytes(".rtfarm.v1").compile_fds(files)?;
    Ok(())
}
