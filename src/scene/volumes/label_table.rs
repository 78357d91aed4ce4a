//! Names of labels in the header of a NIfTI volume: the Caret extension, as TotalSegmentator and Connectome Workbench write it.

use ::nifti::Endianness;

/// More than any atlas has.
const MOST_LABELS: usize = 1 << 14;
/// Bytes of a name that are kept.
const MOST_BYTES: usize = 120;
/// Nodes of its XML that are looked at.
const MOST_NODES: u32 = 1 << 18;

/// Numbers and names of the label table in the bytes between header and voxels; empty without one, or where it is damaged: names are a
/// convenience.
pub(super) fn label_names(extensions: &[u8], endianness: Endianness) -> Vec<(u32, String)> {
    // Four bytes say whether extensions follow; each of those begins with its length and a code.
    let Some((flag, mut rest)) = extensions.split_at_checked(4) else { return Vec::new() };
    if flag[0] == 0 {
        return Vec::new();
    }
    while let Some(length) = rest.first_chunk::<4>() {
        let length = match endianness {
            Endianness::Little => i32::from_le_bytes(*length),
            Endianness::Big => i32::from_be_bytes(*length),
        };
        let Ok(length) = usize::try_from(length) else { break };
        if length < 8 || length > rest.len() {
            break;
        }
        let names = std::str::from_utf8(&rest[8..length]).map(names_of_xml).unwrap_or_default();
        if !names.is_empty() {
            return names;
        }
        rest = &rest[length..];
    }
    Vec::new()
}

fn names_of_xml(text: &str) -> Vec<(u32, String)> {
    let options = roxmltree::ParsingOptions { nodes_limit: MOST_NODES, ..Default::default() };
    let Ok(document) = roxmltree::Document::parse_with_options(text.trim_matches(['\0', ' ', '\n']), options) else {
        return Vec::new();
    };
    let labels = document.descendants().filter(|node| node.has_tag_name("Label"));
    let named = labels.filter_map(|label| {
        let number: u32 = label.attribute("Key")?.trim().parse().ok()?;
        let name = label.text()?.trim();
        (!name.is_empty() && name.len() <= MOST_BYTES).then(|| (number, name.to_owned()))
    });
    named.take(MOST_LABELS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn extension(xml: &str) -> Vec<u8> {
        let mut bytes = vec![1, 0, 0, 0];
        bytes.extend((xml.len() as i32 + 8).to_le_bytes());
        bytes.extend([0; 4]);
        bytes.extend(xml.as_bytes());
        bytes
    }

    #[test]
    fn the_table_of_a_segmentation_is_read_and_a_damaged_one_is_none() {
        let xml = "<?xml version=\"1.0\"?> <CaretExtension><VolumeInformation><LabelTable>\n<Label Key=\"7\" \
                   Red=\"0\"><![CDATA[hip_left]]></Label><Label Key=\"x\">odd</Label></LabelTable></VolumeInformation></CaretExtension>\0\0";
        let bytes = extension(xml);
        assert_eq!(label_names(&bytes, Endianness::Little), [(7, "hip_left".to_owned())]);
        for damaged in [&bytes[..bytes.len() - 20], &bytes[..9], &bytes[..3], &[]] {
            assert_eq!(label_names(damaged, Endianness::Little), []);
        }
        assert_eq!(label_names(&bytes, Endianness::Big), [], "lengths of the other order");
        assert_eq!(label_names(&extension("<Label Key=\"7\">"), Endianness::Little), []);
    }
}
