//! Making sure of trees that come from a file: after this, every look-up ends at something that is there.

use super::{Content, Entry, Node, Trees, mask};
use crate::codec::Codec;
use crate::space::{NODE4_SLOTS, NODE5_SLOTS};

/// What is wrong with packed trees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TreeError {
    /// A node without a mask, entries that are not there, or a mask that contradicts itself.
    #[error("a node that is damaged")]
    Node,
    /// An entry of unknown kind, or of a kind that its level cannot hold.
    #[error("an entry that is damaged")]
    Entry,
    /// A constant that is infinite or no number.
    #[error("a constant that is no number")]
    NotFinite,
}

impl Trees {
    /// Checks all arrays. `is_brick` says whether a brick of that codec stands at that offset of the brick store.
    ///
    /// # Errors
    /// The first thing that is wrong.
    pub fn check(&self, is_brick: impl Fn(Codec, u32) -> bool) -> Result<(), TreeError> {
        for cell in &self.cells {
            self.check_entry(cell.entry, |content| self.is_node(content, &self.node5s))?;
        }
        for node in &self.node5s {
            for entry in self.checked_entries(node, NODE5_SLOTS)? {
                self.check_entry(*entry, |content| self.is_node(content, &self.node4s))?;
            }
        }
        for node in &self.node4s {
            for entry in self.checked_entries(node, NODE4_SLOTS)? {
                self.check_entry(*entry, |content| match content {
                    Content::Brick { codec, offset } => is_brick(codec, offset),
                    _ => false,
                })?;
            }
        }
        Ok(())
    }

    fn is_node(&self, content: Content, nodes: &[Node]) -> bool {
        matches!(content, Content::Node(node) if (node as usize) < nodes.len())
    }

    fn check_entry(&self, entry: Entry, is_child: impl Fn(Content) -> bool) -> Result<(), TreeError> {
        match entry.content().ok_or(TreeError::Entry)? {
            Content::Constant(value) if !value.is_finite() => Err(TreeError::NotFinite),
            Content::Constant(_) => Ok(()),
            content if is_child(content) => Ok(()),
            _ => Err(TreeError::Entry),
        }
    }

    /// The entries of a node whose mask is what [`mask::encode`] makes of its bits.
    fn checked_entries(&self, node: &Node, slots: usize) -> Result<&[Entry], TreeError> {
        let bits = mask::decode(&self.masks, node.mask, slots).ok_or(TreeError::Node)?;
        let count = bits.iter().map(|word| word.count_ones() as usize).sum::<usize>();
        let words = mask::encode(&bits);
        let begin = node.mask as usize;
        if self.masks.get(begin..begin + words.len()) != Some(&words[..]) {
            return Err(TreeError::Node);
        }
        let first = node.first_entry as usize;
        self.entries.get(first..first + count).ok_or(TreeError::Node)
    }
}
