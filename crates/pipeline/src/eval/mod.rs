//! What the tables of an evaluation are computed from: the storage schemes of a master's thesis on rendering VDB files,
//! so that our own can be held against them, and trees of any node sizes.
//!
//! [`scheme`] stores the bricks of a tree as the thesis does and gives back what a reader would see; [`topology`]
//! counts the nodes and bytes of a tree of given node sizes, and the cells that a ray visits in it. What does not live
//! here: pictures of what comes out, and tables, which are the program's; our own formats, in [`pack`](crate::pack).

pub mod scheme;
pub mod topology;
