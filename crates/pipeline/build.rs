//! Names the C++ runtime for the linker where the native encoders need it: their library holds a C++ object,
//! and does not say so.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    if std::env::var_os("CARGO_FEATURE_NATIVE_ENCODERS").is_none() {
        return;
    }
    match std::env::var("CARGO_CFG_TARGET_OS").as_deref() {
        Ok("linux") => println!("cargo:rustc-link-lib=stdc++"),
        Ok("macos" | "ios" | "android") => println!("cargo:rustc-link-lib=c++"),
        _ => {}
    }
}
