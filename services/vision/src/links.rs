//! The links of a node in a graph that is clustered: few at most nodes, and very many at some.

use std::collections::BTreeMap;

/// Links up to which a node holds them as a list; a longer one would take long to change.
const MOST_LISTED: usize = 32;

/// What links a node with others, by their numbers. A list takes less than half the memory of a map.
pub(crate) enum NodeLinks<T> {
    /// Sorted by number.
    Few(Vec<(u32, T)>),
    /// Of a node that had more than a list takes.
    Many(BTreeMap<u32, T>),
}

impl<T> Default for NodeLinks<T> {
    fn default() -> NodeLinks<T> {
        NodeLinks::Few(Vec::new())
    }
}

impl<T: Copy + Default> NodeLinks<T> {
    /// Without links yet, and with memory for so many.
    pub fn with_capacity(links: usize) -> NodeLinks<T> {
        NodeLinks::Few(Vec::with_capacity(links.min(MOST_LISTED)))
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        match self {
            NodeLinks::Few(list) => list.len(),
            NodeLinks::Many(map) => map.len(),
        }
    }

    /// The link to a node; `None` where there is none.
    pub fn get(&self, node: u32) -> Option<T> {
        match self {
            NodeLinks::Few(list) => Some(list[list.binary_search_by_key(&node, |link| link.0).ok()?].1),
            NodeLinks::Many(map) => map.get(&node).copied(),
        }
    }

    /// The link to a node, made where there is none.
    pub fn entry(&mut self, node: u32) -> &mut T {
        if let NodeLinks::Few(list) = self
            && list.len() >= MOST_LISTED
        {
            *self = NodeLinks::Many(std::mem::take(list).into_iter().collect());
        }
        match self {
            NodeLinks::Few(list) => {
                let at = list.binary_search_by_key(&node, |link| link.0).unwrap_or_else(|at| {
                    list.insert(at, (node, T::default()));
                    at
                });
                &mut list[at].1
            }
            NodeLinks::Many(map) => map.entry(node).or_default(),
        }
    }

    /// Removes the link to a node, if there is one.
    pub fn remove(&mut self, node: u32) {
        match self {
            NodeLinks::Few(list) => {
                if let Ok(at) = list.binary_search_by_key(&node, |link| link.0) {
                    list.remove(at);
                }
            }
            NodeLinks::Many(map) => {
                map.remove(&node);
            }
        }
    }

    /// All links, in the order of nodes.
    pub fn iter(&self) -> impl Iterator<Item = (u32, T)> {
        let (list, map) = match self {
            NodeLinks::Few(list) => (Some(list), None),
            NodeLinks::Many(map) => (None, Some(map)),
        };
        let of_list = list.into_iter().flatten().copied();
        of_list.chain(map.into_iter().flatten().map(|(&node, &link)| (node, link)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_are_those_of_a_map_whether_few_or_many() {
        let mut state = 3u64;
        let mut random = |below: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) % below
        };
        // Links to up to 30 nodes stay a list, and those to about 130 of 200 do not.
        for nodes in [1, 5, 30, 200] {
            let (mut links, mut map) = (NodeLinks::<f64>::with_capacity(4), BTreeMap::<u32, f64>::new());
            for _ in 0..1000 {
                let node = random(nodes) as u32;
                if random(3) == 0 {
                    links.remove(node);
                    map.remove(&node);
                } else {
                    let more = random(100) as f64;
                    *links.entry(node) += more;
                    *map.entry(node).or_default() += more;
                }
                assert_eq!((links.len(), links.get(node)), (map.len(), map.get(&node).copied()));
            }
            assert!(links.iter().eq(map.iter().map(|(&node, &link)| (node, link))), "{nodes} nodes");
            assert_eq!(matches!(links, NodeLinks::Many(_)), nodes == 200, "{nodes} nodes");
        }
    }
}
