//! How much memory a file may make the reader take.
//!
//! Every allocation whose size comes from the file goes through a [`Budget`] first, so a damaged or hostile
//! file ends in [`Error::Limit`] and not in the out-of-memory killer.

use crate::error::{Error, Result};

/// Limits on what a file may ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// The most memory, in bytes, that opening a file or reading one grid may take for what the file says:
    /// headers and metadata, or topology, values and the grid's compressed bytes. The reader's own working
    /// memory (a few megabytes per thread) comes on top.
    pub max_memory_bytes: u64,
}

impl Default for Limits {
    /// 16 GiB: more than any grid in daily use, less than a workstation's memory.
    fn default() -> Self {
        Limits { max_memory_bytes: 16 << 30 }
    }
}

/// Memory taken so far under a limit.
#[derive(Debug, Clone)]
pub(crate) struct Budget {
    limit_bytes: u64,
    taken_bytes: u64,
}

impl Budget {
    pub(crate) fn new(limits: &Limits) -> Self {
        Budget { limit_bytes: limits.max_memory_bytes, taken_bytes: 0 }
    }

    /// The bytes that may still be taken.
    pub(crate) fn left_bytes(&self) -> u64 {
        self.limit_bytes - self.taken_bytes
    }

    /// Counts `count` items of `item_bytes` each, before they are allocated.
    pub(crate) fn take(&mut self, count: usize, item_bytes: usize, what: &str) -> Result<()> {
        let needed_bytes = (count as u64).saturating_mul(item_bytes as u64).saturating_add(self.taken_bytes);
        if needed_bytes > self.limit_bytes {
            return Err(Error::Limit { what: what.to_owned(), needed_bytes, limit_bytes: self.limit_bytes });
        }
        self.taken_bytes = needed_bytes;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_refuses_the_byte_that_passes_the_limit_and_never_wraps() {
        let mut budget = Budget::new(&Limits { max_memory_bytes: 100 });
        budget.take(9, 11, "a").unwrap();
        assert!(matches!(
            budget.take(2, 1, "b"),
            Err(Error::Limit { needed_bytes: 101, limit_bytes: 100, .. })
        ));
        budget.take(1, 1, "c").unwrap();
        assert!(budget.take(usize::MAX, usize::MAX, "d").is_err());
    }
}
