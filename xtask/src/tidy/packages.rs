//! The rules for packages: which crates there are, who imports whom, where a dependency may be used, and what every
//! manifest takes from the workspace.
//!
//! Works on plain data, so that each rule is tested without a repository.

use super::Finding;

/// A package of the workspace, as far as the rules need it.
#[derive(Debug, Default)]
pub(super) struct Package {
    pub(super) name: String,
    /// From the root of the repository, with `/`.
    pub(super) manifest_path: String,
    /// The text of the manifest.
    pub(super) manifest: String,
    pub(super) dependencies: Vec<Dependency>,
}

#[derive(Debug, Default)]
pub(super) struct Dependency {
    pub(super) name: String,
    /// For tests and benchmarks only.
    pub(super) is_development: bool,
    pub(super) is_optional: bool,
    pub(super) has_default_features: bool,
}

/// Every package there may be: its name, its folder, and our packages that it may import.
const PACKAGES: &[(&str, &str, &[&str])] = &[
    ("nuage-vdb", "crates/vdb", &[]),
    ("nuage-volume", "crates/volume", &[]),
    ("nuage-pipeline", "crates/pipeline", &["nuage-vdb", "nuage-volume"]),
    ("nuage-render", "crates/render", &["nuage-volume"]),
    ("nuage-gpu", "crates/gpu", &["nuage-volume", "nuage-render"]),
    ("nuage", "crates/cli", LIBRARIES),
    ("nuage-viewer", "crates/viewer", LIBRARIES),
    ("nuage-python", "crates/python", LIBRARIES),
    ("nuage-testkit", "crates/testkit", &[]),
    ("xtask", "xtask", &[]),
];

const LIBRARIES: &[&str] = &["nuage-vdb", "nuage-volume", "nuage-pipeline", "nuage-render", "nuage-gpu"];
const FRONT_ENDS: &[&str] = &["nuage", "nuage-viewer", "nuage-python"];

/// A dependency that only some packages may use (tests aside), and those where it must be optional.
struct Confined {
    name: &'static str,
    allowed: &'static [&'static str],
    optional_in: &'static [&'static str],
}

const CONFINED: &[Confined] = &[
    Confined { name: "clap", allowed: &["nuage"], optional_in: &[] },
    Confined { name: "pyo3", allowed: &["nuage-python"], optional_in: &[] },
    Confined { name: "wgpu", allowed: &["nuage-gpu", "nuage-viewer"], optional_in: &[] },
    Confined {
        name: "memmap2",
        allowed: &["nuage-pipeline", "nuage", "nuage-viewer", "nuage-python"],
        optional_in: &["nuage-pipeline"],
    },
    Confined { name: "glob", allowed: &["nuage-pipeline", "nuage"], optional_in: &["nuage-pipeline"] },
    Confined { name: "tempfile", allowed: &["nuage-pipeline", "nuage"], optional_in: &["nuage-pipeline"] },
    Confined {
        name: "rayon",
        allowed: &["nuage-vdb", "nuage-pipeline", "nuage-render", "nuage", "nuage-viewer", "nuage-python"],
        optional_in: &["nuage-vdb", "nuage-pipeline", "nuage-render"],
    },
];

/// What every `[package]` section takes from the workspace.
const INHERITED: &[&str] = &["edition", "rust-version", "license"];

/// Checks one package.
pub(super) fn check(package: &Package) -> Vec<Finding> {
    let mut findings = check_manifest(package);
    let Some((_, folder, may_import)) = PACKAGES.iter().find(|(name, ..)| *name == package.name) else {
        findings.push(Finding::new(
            &package.manifest_path,
            1,
            format!(
                "`{}` is not a package of the design: make it a module, or add it to the table in \
                 xtask/src/tidy/packages.rs with a decision in docs/decisions/",
                package.name
            ),
        ));
        return findings;
    };
    if package.manifest_path != format!("{folder}/Cargo.toml") {
        findings.push(Finding::new(
            &package.manifest_path,
            1,
            format!("`{}` belongs in {folder}: move it there", package.name),
        ));
    }
    for dependency in &package.dependencies {
        let objections = [
            object_to_import(&package.name, may_import, dependency),
            object_to_confined(&package.name, dependency),
        ];
        let line = line_of_dependency(&package.manifest, &dependency.name);
        findings.extend(
            objections
                .into_iter()
                .flatten()
                .map(|message| Finding::new(&package.manifest_path, line, message)),
        );
    }
    findings
}

fn object_to_import(package: &str, may_import: &[&str], dependency: &Dependency) -> Option<String> {
    let name = dependency.name.as_str();
    if !PACKAGES.iter().any(|(ours, ..)| *ours == name) {
        return None;
    }
    if FRONT_ENDS.contains(&name) {
        return Some(format!(
            "`{name}` is a front end, which nothing imports: move what is needed into a library"
        ));
    }
    if dependency.is_development {
        return None;
    }
    if name == "nuage-testkit" {
        return Some("nuage-testkit is for tests only: move it to [dev-dependencies]".to_owned());
    }
    if !may_import.contains(&name) {
        return Some(format!(
            "`{package}` may not import `{name}` (it may import: {}): move the code to a crate that may",
            if may_import.is_empty() { "nothing of ours".to_owned() } else { may_import.join(", ") }
        ));
    }
    if (package, name) == ("nuage-gpu", "nuage-render") && dependency.has_default_features {
        return Some(
            "nuage-gpu takes only scene and parameters from nuage-render: set default-features = false"
                .into(),
        );
    }
    None
}

fn object_to_confined(package: &str, dependency: &Dependency) -> Option<String> {
    let confined =
        CONFINED.iter().find(|confined| confined.name == dependency.name && !dependency.is_development)?;
    let name = confined.name;
    if !confined.allowed.contains(&package) {
        return Some(format!(
            "`{name}` may be used only in {}: move the code there",
            confined.allowed.join(", ")
        ));
    }
    if confined.optional_in.contains(&package) && !dependency.is_optional {
        return Some(format!(
            "`{name}` must be optional here, behind a feature, so that the crate builds for wasm"
        ));
    }
    None
}

fn check_manifest(package: &Package) -> Vec<Finding> {
    let mut findings = Vec::new();
    let settings = settings(&package.manifest);
    let has = |key: &str| settings.iter().any(|setting| setting == key);
    for key in INHERITED {
        if !has(&format!("package.{key}.workspace=true"))
            && !has(&format!("package.{key}={{workspace=true}}"))
        {
            let message = format!("the package states its own {key}: write `{key}.workspace = true`");
            findings.push(Finding::new(&package.manifest_path, 1, message));
        }
    }
    if !has("lints.workspace=true") {
        let message = "the lints of the workspace are not in force: add `[lints]` with `workspace = true`";
        findings.push(Finding::new(&package.manifest_path, 1, message));
    }
    findings
}

/// The lines `key = value` of a manifest without spaces, each with the name of its section in front.
fn settings(manifest: &str) -> Vec<String> {
    let mut section = String::new();
    let mut settings = Vec::new();
    for line in manifest.lines() {
        let line: String = line.split('#').next().unwrap_or_default().split_whitespace().collect();
        if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            section = format!("{name}.");
        } else if !line.is_empty() {
            settings.push(section.clone() + &line);
        }
    }
    settings
}

fn line_of_dependency(manifest: &str, name: &str) -> usize {
    let starts = |line: &str| {
        let rest = line.trim_start().trim_start_matches('[');
        let key = rest.rsplit("dependencies.").next().unwrap_or(rest);
        key.strip_prefix(name).is_some_and(|rest| rest.starts_with([' ', '.', '=', ']']))
    };
    manifest.lines().position(starts).map_or(1, |at| at + 1)
}

/// Every package must be named, by its folder, in the overview of the architecture.
pub(super) fn check_overview(packages: &[Package], path: &str, overview: &str) -> Vec<Finding> {
    let mut findings = Vec::new();
    for package in packages {
        let folder = package.manifest_path.trim_end_matches("/Cargo.toml");
        // `crates/vdb` is not named by `crates/vdbx`.
        let is_named = overview.match_indices(folder).any(|(at, _)| {
            let next = overview[at + folder.len()..].chars().next();
            !next.is_some_and(|next| next.is_alphanumeric() || next == '-' || next == '_')
        });
        if !is_named {
            findings.push(Finding::new(
                path,
                1,
                format!("it doesn't name `{folder}`: say there what that crate does"),
            ));
        }
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::*;

    const MANIFEST: &str = "[package]\nname = \"x\"\nedition.workspace = true\nrust-version = { workspace = true }\n\
                            license.workspace = true # as all\n\n[lints]\nworkspace = true\n";

    fn package(name: &str, dependencies: Vec<Dependency>) -> Package {
        let folder =
            PACKAGES.iter().find(|(known, ..)| *known == name).map_or("crates/new", |(_, folder, _)| folder);
        Package {
            name: name.to_owned(),
            manifest_path: format!("{folder}/Cargo.toml"),
            manifest: MANIFEST.to_owned(),
            dependencies,
        }
    }

    fn normal(name: &str) -> Dependency {
        Dependency { name: name.to_owned(), ..Dependency::default() }
    }

    fn development(name: &str) -> Dependency {
        Dependency { is_development: true, ..normal(name) }
    }

    fn optional(name: &str) -> Dependency {
        Dependency { is_optional: true, ..normal(name) }
    }

    /// The messages about a package with one dependency.
    fn objections(name: &str, dependency: Dependency) -> Vec<String> {
        check(&package(name, vec![dependency])).iter().map(Finding::to_string).collect()
    }

    #[test]
    fn what_the_design_allows_passes() {
        for (name, _, may_import) in PACKAGES {
            for import in *may_import {
                assert_eq!(objections(name, normal(import)), [""; 0]);
            }
            assert_eq!(objections(name, development("nuage-testkit")), [""; 0]);
        }
        assert_eq!(objections("nuage-render", development("nuage-pipeline")), [""; 0]);
        assert_eq!(objections("nuage-vdb", development("tempfile")), [""; 0]);
        assert_eq!(objections("nuage-vdb", optional("rayon")), [""; 0]);
        assert_eq!(objections("nuage", normal("clap")), [""; 0]);
    }

    #[test]
    fn each_import_that_the_design_forbids_fails() {
        for (name, import) in [
            ("nuage-vdb", "nuage-volume"),
            ("nuage-volume", "nuage-vdb"),
            ("nuage-pipeline", "nuage-render"),
            ("nuage-render", "nuage-vdb"),
            ("nuage-gpu", "nuage-pipeline"),
            ("nuage-testkit", "nuage-volume"),
            ("xtask", "nuage-vdb"),
            ("nuage", "nuage-viewer"),
            ("nuage-python", "nuage"),
            ("nuage-vdb", "nuage-testkit"),
        ] {
            assert_eq!(objections(name, normal(import)).len(), 1, "{name} imports {import}");
        }
        assert_eq!(objections("nuage-gpu", development("nuage-viewer")).len(), 1);
        let whole = Dependency { has_default_features: true, ..normal("nuage-render") };
        assert_eq!(objections("nuage-gpu", whole).len(), 1);
    }

    #[test]
    fn a_dependency_outside_its_crates_fails() {
        for (name, dependency) in [
            ("nuage-viewer", "clap"),
            ("nuage", "pyo3"),
            ("nuage-render", "wgpu"),
            ("nuage-vdb", "memmap2"),
            ("nuage-render", "glob"),
            ("nuage-testkit", "tempfile"),
            ("nuage-volume", "rayon"),
        ] {
            assert_eq!(objections(name, optional(dependency)).len(), 1, "{dependency} in {name}");
        }
        for dependency in ["rayon", "glob", "tempfile", "memmap2"] {
            assert_eq!(
                objections("nuage-pipeline", normal(dependency)).len(),
                1,
                "{dependency} not optional"
            );
        }
    }

    #[test]
    fn a_package_that_the_design_does_not_know_fails() {
        assert_eq!(check(&package("nuage-utils", Vec::new())).len(), 1);
        let moved =
            Package { manifest_path: "crates/other/Cargo.toml".into(), ..package("nuage-vdb", Vec::new()) };
        assert_eq!(check(&moved).len(), 1);
    }

    #[test]
    fn each_setting_that_is_not_inherited_fails() {
        for line in [
            "edition.workspace = true",
            "rust-version = { workspace = true }",
            "license.workspace = true",
            "[lints]",
        ] {
            let changed =
                Package { manifest: MANIFEST.replace(line, ""), ..package("nuage-vdb", Vec::new()) };
            assert_eq!(check(&changed).len(), 1, "without {line}");
        }
    }

    #[test]
    fn a_finding_points_at_the_line_of_the_dependency() {
        let manifest = format!("{MANIFEST}[dependencies]\nclap_x = \"1\"\nclap.workspace = true\n");
        let package = Package { manifest, ..package("nuage-vdb", vec![normal("clap")]) };
        let findings = check(&package);
        assert_eq!(findings.len(), 1);
        assert!(findings[0].to_string().starts_with("crates/vdb/Cargo.toml:11: `clap`"), "{}", findings[0]);
    }

    #[test]
    fn a_package_that_the_overview_leaves_out_fails() {
        let packages = [package("nuage-vdb", Vec::new()), package("nuage-volume", Vec::new())];
        assert_eq!(check_overview(&packages, "A.md", "`crates/vdb` reads, `crates/volume` packs").len(), 0);
        assert_eq!(check_overview(&packages, "A.md", "`crates/vdb` reads, `crates/volumes` packs").len(), 1);
        assert_eq!(check_overview(&packages, "A.md", "").len(), 2);
    }
}
