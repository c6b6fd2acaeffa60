//! Disjoint sets.

/// Disjoint sets of the numbers below a bound.
#[derive(Debug)]
pub struct UnionFind(Vec<u32>);

impl UnionFind {
    /// Makes `count` sets of one number each.
    pub fn new(count: usize) -> Self {
        Self((0..count as u32).collect())
    }

    /// Returns the smallest number of the set of `at`.
    pub fn root(&mut self, at: usize) -> usize {
        let mut at = at as u32;
        while self.0[at as usize] != at {
            let above = self.0[self.0[at as usize] as usize];
            self.0[at as usize] = above;
            at = above;
        }
        at as usize
    }

    /// Joins the sets of two numbers.
    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b) as u32;
    }
}
