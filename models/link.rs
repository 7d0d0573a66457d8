//! Build script shared by every crate whose binaries or tests link libtorch.
//!
//! Link arguments do not propagate from torch-sys to the final artefact, so each such crate names this
//! file as its build script: it records where libtorch lies (no `LD_LIBRARY_PATH` needed; `$ORIGIN/../lib`
//! serves a packaged binary) and keeps the libraries that `--as-needed` would drop although they register
//! themselves at load, such as `libtorch_cuda`.

#![expect(clippy::print_stdout, reason = "a build script speaks to cargo by printing")]

use std::path::Path;

fn main() {
    let Ok(lib) = std::env::var("DEP_TCH_LIBTORCH_LIB") else { return };
    println!("cargo:rustc-link-arg=-Wl,--disable-new-dtags,-rpath,{lib},-rpath,$ORIGIN/../lib");
    println!("cargo:rustc-link-arg=-Wl,--no-as-needed");
    if Path::new(&lib).join("libtorch_cuda.so").exists() {
        println!("cargo:rustc-link-arg=-ltorch_cuda");
    }
    println!("cargo:rustc-link-arg=-ltorch");
    println!("cargo:rerun-if-env-changed=LIBTORCH");
}
