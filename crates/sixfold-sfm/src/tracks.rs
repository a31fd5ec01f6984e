//! Tracks: features of several photographs that show the same point. Matches are joined, the strongest pairs of photographs first,
//! unless this would give a point two features in one photograph.

/// A track: index and feature of each photograph that shows the point, sorted by photograph.
pub(crate) type Track = Vec<(usize, u32)>;

/// Joins matches of features, which must be sorted by trust, the most trusted first. `counts` are the numbers of features of the
/// photographs.
pub(crate) fn joined(counts: &[usize], matches: impl Iterator<Item = [(usize, u32); 2]>) -> Vec<Track> {
    let mut first = vec![0usize];
    counts.iter().for_each(|count| first.push(first[first.len() - 1] + count));
    let mut group: Vec<usize> = (0..first[counts.len()]).collect();
    let mut tracks: Vec<Track> = vec![];
    for (photograph, count) in counts.iter().enumerate() {
        tracks.extend((0..*count).map(|feature| vec![(photograph, feature as u32)]));
    }
    for [a, b] in matches {
        let (mut into, mut from) = (group[first[a.0] + a.1 as usize], group[first[b.0] + b.1 as usize]);
        if into == from || share_a_photograph(&tracks[into], &tracks[from]) {
            continue;
        }
        if tracks[into].len() < tracks[from].len() {
            (into, from) = (from, into);
        }
        let moved = std::mem::take(&mut tracks[from]);
        moved.iter().for_each(|(photograph, feature)| group[first[*photograph] + *feature as usize] = into);
        tracks[into].extend(moved);
        tracks[into].sort_unstable();
    }
    tracks.retain(|t| t.len() > 1);
    tracks
}

fn share_a_photograph(a: &Track, b: &Track) -> bool {
    let (mut i, mut j) = (0, 0);
    while i < a.len() && j < b.len() {
        match a[i].0.cmp(&b[j].0) {
            std::cmp::Ordering::Less => i += 1,
            std::cmp::Ordering::Greater => j += 1,
            std::cmp::Ordering::Equal => return true,
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_join_unless_a_photograph_would_show_a_point_twice() {
        let matches = [[(0, 0), (1, 0)], [(1, 0), (2, 1)], [(0, 1), (2, 1)], [(0, 1), (1, 1)]];
        let found = joined(&[2, 2, 2], matches.into_iter());
        assert_eq!(found, [vec![(0, 0), (1, 0), (2, 1)], vec![(0, 1), (1, 1)]]);
    }
}
