//! The rules of the repository that no compiler checks: who may import whom, which dependency stays where, and what
//! may not stand in a source file.
//!
//! The rules are tables at the top of [`packages`] and [`sources`]; here they meet the repository. Formatting and
//! lints are left to rustfmt and clippy.

mod packages;
mod sources;

use std::error::Error;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use cargo_metadata::{DependencyKind, MetadataCommand};

/// One violation.
#[derive(Debug)]
pub(crate) struct Finding {
    /// From the root of the repository, with `/`.
    path: String,
    /// From 1.
    line: usize,
    /// The rule and how to mend it.
    message: String,
}

impl Finding {
    fn new(path: &str, line: usize, message: impl Into<String>) -> Self {
        Self { path: path.to_owned(), line, message: message.into() }
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}:{}: {}", self.path, self.line, self.message)
    }
}

/// Checks the whole repository that this program was built from.
pub(crate) fn check_workspace() -> Result<Vec<Finding>, Box<dyn Error>> {
    let root = fs::canonicalize(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))?;
    let packages = packages_of(&root)?;
    let mut findings: Vec<Finding> = packages.iter().flat_map(packages::check).collect();
    let overview = fs::read_to_string(root.join("ARCHITECTURE.md")).unwrap_or_default();
    findings.extend(packages::check_overview(&packages, "ARCHITECTURE.md", &overview));
    for path in rust_files(&root)? {
        let text = fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))?;
        findings.extend(sources::check(&relative(&root, &path), &text));
    }
    Ok(findings)
}

fn packages_of(root: &Path) -> Result<Vec<packages::Package>, Box<dyn Error>> {
    let metadata = MetadataCommand::new()
        .manifest_path(root.join("Cargo.toml"))
        .no_deps()
        .other_options(["--offline".into()])
        .exec()?;
    let mut packages = Vec::new();
    for package in metadata.packages {
        let dependency = |dependency: cargo_metadata::Dependency| packages::Dependency {
            name: dependency.name,
            is_development: dependency.kind == DependencyKind::Development,
            is_optional: dependency.optional,
            has_default_features: dependency.uses_default_features,
        };
        packages.push(packages::Package {
            name: package.name.to_string(),
            manifest_path: relative(root, package.manifest_path.as_std_path()),
            manifest: fs::read_to_string(&package.manifest_path)?,
            dependencies: package.dependencies.into_iter().map(dependency).collect(),
        });
    }
    Ok(packages)
}

/// Every `.rs` file, sorted; build outputs and hidden folders left out.
fn rust_files(root: &Path) -> Result<Vec<PathBuf>, Box<dyn Error>> {
    let mut files = Vec::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder)? {
            let entry = entry?;
            let (name, kind) = (entry.file_name(), entry.file_type()?);
            if kind.is_dir() && name != "target" && !name.to_string_lossy().starts_with('.') {
                folders.push(entry.path());
            } else if kind.is_file() && entry.path().extension().is_some_and(|extension| extension == "rs") {
                files.push(entry.path());
            }
        }
    }
    files.sort();
    Ok(files)
}

fn relative(root: &Path, path: &Path) -> String {
    path.strip_prefix(root).unwrap_or(path).to_string_lossy().replace('\\', "/")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_repository_is_tidy() {
        let findings: Vec<String> = check_workspace().unwrap().iter().map(Finding::to_string).collect();
        assert!(findings.is_empty(), "\n{}\n", findings.join("\n"));
    }

    #[test]
    fn the_walk_sees_this_file_and_no_build_output() {
        let root = fs::canonicalize(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).unwrap();
        let files: Vec<String> =
            rust_files(&root).unwrap().iter().map(|path| relative(&root, path)).collect();
        assert!(files.contains(&"xtask/src/tidy.rs".to_owned()));
        assert!(files.iter().all(|path| !path.split('/').any(|part| part == "target")));
    }

    #[test]
    fn the_packages_are_read_with_their_dependencies() {
        let root = fs::canonicalize(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).unwrap();
        let packages = packages_of(&root).unwrap();
        let pipeline = packages.iter().find(|package| package.name == "nuage-pipeline").unwrap();
        assert_eq!(pipeline.manifest_path, "crates/pipeline/Cargo.toml");
        let has = |name: &str, is_development: bool| {
            let found = |it: &&packages::Dependency| it.name == name && it.is_development == is_development;
            pipeline.dependencies.iter().find(found).is_some()
        };
        assert!(has("nuage-vdb", false) && has("nuage-testkit", true) && !has("nuage-testkit", false));
    }
}
