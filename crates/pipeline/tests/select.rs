//! Which grid is meant, on files with several grids, namesakes and none.

use nuage_pipeline::select::{SelectError, density_grid, is_drawable, named_grid, namesakes};
use nuage_testkit as testkit;
use nuage_vdb::File;

fn open(relative: &str) -> Option<File<Vec<u8>>> {
    let path = testkit::find(relative)?;
    Some(File::open(std::fs::read(path).unwrap()).unwrap())
}

fn density_name(file: &File<Vec<u8>>) -> &str {
    &file.grids[density_grid(file).unwrap()].unique_name
}

#[test]
fn of_three_grids_of_one_name_the_first_is_meant_and_each_has_its_own_name() {
    let Some(file) = open("data/public/arnoldusd_grids.vdb") else { return };
    let unique = ["density[0]", "density[1]", "density[2]"];
    assert_eq!(density_name(&file), unique[0]);
    assert_eq!(file.grids[named_grid(&file, "density").unwrap()].unique_name, unique[0]);
    for name in unique {
        let index = named_grid(&file, name).unwrap();
        assert_eq!(file.grids[index].unique_name, name);
        assert_eq!(namesakes(&file, index), unique);
    }
    let Err(SelectError::NotFound { name, available }) = named_grid(&file, "density[3]") else {
        panic!("there is no fourth grid");
    };
    assert_eq!((name.as_str(), available), ("density[3]", unique.join(", ")));
}

#[test]
fn without_a_name_density_is_drawn_else_a_fog_else_a_level_set_else_any_float_grid() {
    for (path, name) in [
        // `density` comes before a level set, whatever the order in the file.
        ("data/edge/comp_sphere_mask.vdb", "density"),
        // A fog volume among grids of every class.
        ("data/edge/classes.vdb", "class_fog volume"),
        // A level set before floats without a class.
        ("data/edge/half_blosc.vdb", "ls_sphere_half"),
        // Other value types do not count.
        ("data/edge/comp_seven_mask.vdb", "seven_float"),
        ("data/edge/types_bloscmask.vdb", "float"),
    ] {
        if let Some(file) = open(path) {
            assert_eq!(density_name(&file), name, "{path}");
        }
    }
}

#[test]
fn a_namesake_that_cannot_be_drawn_does_not_hide_one_that_can() {
    let Some(mut file) = open("data/edge/types_bloscmask.vdb") else { return };
    file.grids.retain(|grid| grid.name == "bool" || grid.name == "float");
    file.grids.sort_by_key(is_drawable);
    for (number, grid) in file.grids.iter_mut().enumerate() {
        grid.name = "density".to_owned();
        grid.unique_name = format!("density[{number}]");
    }
    assert_eq!(density_name(&file), "density[1]");
}

#[test]
fn the_choice_is_the_best_there_is_in_every_file_with_truth() {
    let rank = |grid: &nuage_vdb::GridInfo| match (grid.name.as_str(), grid.grid_class()) {
        ("density", _) => 0,
        (_, "fog volume") => 1,
        (_, "level set") => 2,
        _ => 3,
    };
    let (mut chosen, mut refused) = (0, 0);
    for (path, truth) in testkit::truths() {
        let file = File::open(std::fs::read(&path).unwrap()).unwrap();
        let float = |grid: &serde_json::Value| grid["grid_type"] == "Tree_float_5_4_3";
        let drawable = truth["grids"].as_array().unwrap().iter().any(float);
        match density_grid(&file) {
            Ok(index) => {
                let grid = &file.grids[index];
                assert!(drawable && is_drawable(grid), "{}: {}", path.display(), grid.unique_name);
                let best = file.grids.iter().filter(|g| is_drawable(g)).map(rank).min();
                assert_eq!(Some(rank(grid)), best, "{}: {}", path.display(), grid.unique_name);
                chosen += 1;
            }
            Err(error) => {
                assert!(!drawable, "{}: {error}", path.display());
                for grid in &file.grids {
                    let named = format!("{} ({})", grid.unique_name, grid.value_type());
                    assert!(error.to_string().contains(&named), "{error}");
                }
                refused += 1;
            }
        }
    }
    assert!(chosen >= 30 && refused >= 1, "{chosen} chosen, {refused} refused");
}

#[test]
fn a_file_without_grids_says_so() {
    let file = open("data/edge/no_grids.vdb").unwrap();
    assert_eq!(
        density_grid(&file).unwrap_err().to_string(),
        "the file has no float grid to draw; it has: no grids"
    );
    assert_eq!(
        named_grid(&file, "density").unwrap_err().to_string(),
        "grid 'density' not found; the file has: no grids"
    );
    assert!(namesakes(&file, 0).is_empty());
}
