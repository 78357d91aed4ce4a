//! What filters a beam besides its tube, by a frame's header, by telemetry or by a person's word, and whether two of them are one: what a
//! panel sees with nothing in the beam holds for one filter alone.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::beam_tags::{
    ALUMINIUM_APART_MM, COPPER_APART_MM, FilterForm, FilterLayer, FilterMaterial, FilterTags, OWN_ALUMINIUM_MM, thickness_words,
};
use super::tags::FrameTags;
use crate::telemetry::CarmSample;

/// Foils of other metals are hundredths of a millimetre thick.
const FOIL_APART_MM: f64 = 0.005;

/// Who says which filter it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FilterSource {
    /// The frame's header.
    Header,
    /// Whoever calibrated the panel.
    Person,
    /// The C-arm's line, which tells of aluminium and copper.
    Telemetry,
}

/// The filter in the beam of an exposure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AddedFilter {
    /// Who says so.
    pub stated_by: FilterSource,
    /// Its shape, where that is said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub form: Option<FilterForm>,
    /// What it is made of.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub layers: Vec<FilterLayer>,
}

/// How two filters stand to each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Likeness {
    /// They are the same.
    Same,
    /// Too little is said of one of them.
    Perhaps,
    /// They are not.
    Other,
}

impl Likeness {
    /// Of what may not be stated at all.
    #[must_use]
    pub fn between(a: Option<&AddedFilter>, b: Option<&AddedFilter>) -> Self {
        a.zip(b).map_or(Self::Perhaps, |(a, b)| a.likeness(b))
    }
}

/// What is no filter.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{found:?} is no added filter; expected none, or materials with mm, as copper=0.2,aluminium=1 (of {known})")]
pub struct AddedFilterError {
    found: String,
    known: String,
}

impl FromStr for AddedFilter {
    type Err = AddedFilterError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let by_person = |form, layers| Self { stated_by: FilterSource::Person, form, layers };
        if text.trim().eq_ignore_ascii_case("none") {
            return Ok(by_person(Some(FilterForm::NoFilter), Vec::new()));
        }
        let layer = |part: &str| {
            let (name, thickness) = part.split_once('=')?;
            let mm = thickness.trim().parse().ok().filter(|mm: &f64| *mm >= 0.0 && mm.is_finite())?;
            Some(FilterLayer { material: FilterMaterial::named(name)?, thickness_mm: Some([mm; 2]) })
        };
        let layers: Option<Vec<FilterLayer>> = text.split(',').map(layer).collect();
        let known = || FilterMaterial::ALL.map(|material| material.names()[0]).join(", ");
        layers.map(|layers| by_person(None, layers)).ok_or_else(|| AddedFilterError { found: text.to_owned(), known: known() })
    }
}

impl AddedFilter {
    /// Of an exposure: by the frame's header, else by telemetry. `None` where neither tells of it.
    #[must_use]
    pub fn of(tags: &FrameTags, told: Option<&CarmSample>) -> Option<Self> {
        let by_header = tags.filter.as_ref().map(Self::by_header);
        // Of a filter of which nothing is understood telemetry may tell.
        let is_understood = |filter: &Self| {
            let mut materials = filter.layers.iter().map(|layer| layer.material);
            filter.form.is_some() || materials.any(|material| material != FilterMaterial::Other)
        };
        match by_header {
            Some(filter) if is_understood(&filter) => Some(filter),
            unknown => told.and_then(Self::by_telemetry).or(unknown),
        }
    }

    /// Of a frame's header.
    #[must_use]
    pub fn by_header(tags: &FilterTags) -> Self {
        Self { stated_by: FilterSource::Header, form: tags.form, layers: tags.layers.clone() }
    }

    /// What is not measured is NaN.
    fn by_telemetry(beam: &CarmSample) -> Option<Self> {
        let told = [(FilterMaterial::Aluminum, beam.filter_mm_al), (FilterMaterial::Copper, beam.filter_mm_cu)];
        let layer = |(material, mm): (FilterMaterial, f64)| {
            let thickness_mm = (mm >= 0.0 && mm.is_finite()).then_some([mm; 2]);
            FilterLayer { material, thickness_mm }
        };
        let layers = told.map(layer).to_vec();
        let is_told = layers.iter().any(|layer| layer.thickness_mm.is_some());
        is_told.then_some(Self { stated_by: FilterSource::Telemetry, form: None, layers })
    }

    fn names(&self, material: FilterMaterial) -> bool {
        self.layers.iter().any(|layer| layer.material == material)
    }

    /// Least and most thickness of `material`, its layers together; `None` where that is not said. Against the word of `another` source less
    /// is said: consoles write zero where they do not know, and some leave out sheets that are fixed in the housing.
    #[must_use]
    pub fn thickness_mm(&self, material: FilterMaterial, another: bool) -> Option<[f64; 2]> {
        let Self { stated_by, form, layers } = self;
        if !self.names(material) {
            // Where what is in the beam is listed, nothing else is in it. Telemetry has no word for other metals.
            let lists_all = !layers.is_empty() || *form == Some(FilterForm::NoFilter);
            // The word for another may be one for this.
            let lists_all = lists_all && (material == FilterMaterial::Other || !self.names(FilterMaterial::Other));
            let is_open = *stated_by == FilterSource::Telemetry || another && material == FilterMaterial::Aluminum;
            return (lists_all && !is_open).then_some([0.0; 2]);
        }
        let total_mm = total_mm(layers, material)?;
        let says_nothing = another && *stated_by == FilterSource::Header && !(total_mm[1] > 0.0);
        (!says_nothing).then_some(total_mm)
    }

    /// What is in the beam, and how thick as far as that is stated.
    pub fn materials(&self) -> impl Iterator<Item = (FilterMaterial, Option<[f64; 2]>)> + '_ {
        let named = all().filter(move |material| self.names(*material));
        let stated = named.map(move |material| (material, self.thickness_mm(material, false)));
        let by_telemetry = self.stated_by == FilterSource::Telemetry;
        stated.filter(move |(_, mm)| mm.map_or(!by_telemetry, |[_, most_mm]| most_mm > 0.0))
    }

    /// Whether it is the same as another.
    #[must_use]
    pub fn likeness(&self, other: &Self) -> Likeness {
        if self.form.zip(other.form).is_some_and(|(own, others)| own != others) {
            return Likeness::Other;
        }
        let another = self.stated_by != other.stated_by;
        let mut likeness = Likeness::Same;
        for material in all().filter(|material| self.names(*material) || other.names(*material)) {
            match (self.thickness_mm(material, another), other.thickness_mm(material, another)) {
                (Some(own_mm), Some(others_mm)) => {
                    let apart_mm = (own_mm[0] - others_mm[0]).abs().max((own_mm[1] - others_mm[1]).abs());
                    if !(apart_mm <= most_apart_mm(material, another)) {
                        return Likeness::Other;
                    }
                }
                (None, None) => {}
                (Some(_), None) | (None, Some(_)) => likeness = Likeness::Perhaps,
            }
        }
        likeness
    }

    /// `0.20 mm of copper`, `no added filter`.
    #[must_use]
    pub fn words(&self) -> String {
        let part = |(material, mm): (FilterMaterial, Option<[f64; 2]>)| match mm {
            Some(mm) => format!("{} of {}", thickness_words(mm), material.names()[0]),
            None => format!("{} of a thickness that is not stated", material.names()[0]),
        };
        let parts: Vec<String> = self.materials().map(part).collect();
        let is_unnamed = self.layers.is_empty() && self.form != Some(FilterForm::NoFilter);
        match (parts.is_empty(), is_unnamed) {
            (true, true) => "a filter whose material is not stated".to_owned(),
            (true, false) => "no added filter".to_owned(),
            (false, _) => parts.join(" and "),
        }
    }
}

/// All that a header may name.
fn all() -> impl Iterator<Item = FilterMaterial> {
    FilterMaterial::ALL.into_iter().chain([FilterMaterial::Other])
}

/// Least and most thickness of the layers of `material` together; `None` where that of one is not said.
fn total_mm(layers: &[FilterLayer], material: FilterMaterial) -> Option<[f64; 2]> {
    let mut of_it = layers.iter().filter(|layer| layer.material == material);
    of_it.try_fold([0.0; 2], |[least_mm, most_mm], layer| {
        let [least, most] = layer.thickness_mm?;
        Some([least_mm + least, most_mm + most])
    })
}

/// What may be between two statements of one thickness, from `another` source or the same.
fn most_apart_mm(material: FilterMaterial, another: bool) -> f64 {
    match material {
        FilterMaterial::Aluminum if another => OWN_ALUMINIUM_MM + ALUMINIUM_APART_MM,
        FilterMaterial::Aluminum => ALUMINIUM_APART_MM,
        FilterMaterial::Copper => COPPER_APART_MM,
        _ => FOIL_APART_MM,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn typed(text: &str) -> AddedFilter {
        text.parse().expect("a filter")
    }

    fn header(form: Option<FilterForm>, layers: &[(FilterMaterial, Option<f64>)]) -> AddedFilter {
        let layer = |(material, mm): &(FilterMaterial, Option<f64>)| FilterLayer {
            material: *material,
            thickness_mm: mm.map(|mm| [mm; 2]),
        };
        AddedFilter { stated_by: FilterSource::Header, form, layers: layers.iter().map(layer).collect() }
    }

    fn told(aluminium_mm: f64, copper_mm: f64) -> Option<AddedFilter> {
        let beam = CarmSample { filter_mm_al: aluminium_mm, filter_mm_cu: copper_mm, ..CarmSample::UNTOLD };
        AddedFilter::of(&FrameTags::default(), Some(&beam))
    }

    #[test]
    fn filters_are_the_same_or_others_and_what_is_not_said_decides_nothing() {
        use FilterMaterial::{Aluminum, Copper, Molybdenum};
        use Likeness::{Other, Perhaps, Same};
        let unnamed = FilterMaterial::Other;
        let none = header(Some(FilterForm::NoFilter), &[]);
        let copper = header(Some(FilterForm::Flat), &[(Copper, Some(0.2))]);
        let telemetry = |aluminium_mm, copper_mm| told(aluminium_mm, copper_mm).expect("told");
        let cases = [
            (none.clone(), none.clone(), Same),
            (none.clone(), copper.clone(), Other),
            (copper.clone(), header(Some(FilterForm::Flat), &[(Copper, Some(0.22))]), Same),
            (copper.clone(), header(None, &[(Copper, Some(0.3))]), Other),
            // A material alone is no thickness, and is the same as that of a console which never says more.
            (copper.clone(), header(Some(FilterForm::Flat), &[(Copper, None)]), Perhaps),
            (header(None, &[(Copper, None)]), header(None, &[(Copper, None)]), Same),
            (header(None, &[(Molybdenum, Some(0.03))]), header(None, &[(Molybdenum, Some(0.02))]), Other),
            // One console's sheets of aluminium are told apart; of two sources, either may count what is fixed in the housing.
            (header(None, &[(Aluminum, Some(1.0))]), header(None, &[(Aluminum, Some(2.0))]), Other),
            (header(None, &[(Aluminum, Some(1.0))]), telemetry(4.3, 0.0), Same),
            (none.clone(), telemetry(4.3, 0.0), Perhaps),
            (none.clone(), telemetry(4.3, 0.3), Other),
            (typed("copper=0.2"), telemetry(4.3, 0.2), Perhaps),
            (typed("aluminium=1,Cu=0"), telemetry(4.3, 0.2), Other),
            (typed("none"), copper.clone(), Other),
            (typed("cu=0.2"), copper.clone(), Same),
            // Zero beside a material says nothing to others, and is its own word for none at home.
            (header(None, &[(Copper, Some(0.0))]), telemetry(f64::NAN, 0.2), Perhaps),
            (header(None, &[(Copper, Some(0.0))]), header(None, &[(Copper, Some(0.2))]), Other),
            // A word that nobody understands may be one for copper; it is the same as itself, as a console writes it every time.
            (header(None, &[(Aluminum, Some(1.0)), (unnamed, None)]), telemetry(1.0, 0.2), Perhaps),
            (header(None, &[(Copper, Some(0.2)), (unnamed, None)]), copper.clone(), Perhaps),
            (header(None, &[(Copper, Some(0.2)), (unnamed, None)]), header(None, &[(Copper, Some(0.2)), (unnamed, None)]), Same),
        ];
        for (index, (a, b, expected)) in cases.iter().enumerate() {
            assert_eq!((a.likeness(b), b.likeness(a)), (*expected, *expected), "case {index}: {} and {}", a.words(), b.words());
        }
        assert_eq!(told(f64::NAN, f64::NAN), None, "an arm without a word for its filter");
        assert_eq!(Likeness::between(None, Some(&copper)), Perhaps);
    }

    #[test]
    fn of_a_filter_whose_header_is_not_understood_telemetry_tells_if_it_does() {
        let layers = vec![FilterLayer { material: FilterMaterial::Other, thickness_mm: None }];
        let tags = FrameTags { filter: Some(FilterTags { form: None, layers }), ..FrameTags::default() };
        let beam = CarmSample { filter_mm_cu: 0.2, ..CarmSample::UNTOLD };
        let words = |told| AddedFilter::of(&tags, told).map(|filter| filter.words());
        assert_eq!(words(Some(&beam)).as_deref(), Some("0.20 mm of copper"));
        let unknown = Some("another material of a thickness that is not stated");
        assert_eq!([words(Some(&CarmSample::UNTOLD)).as_deref(), words(None).as_deref()], [unknown; 2]);
    }

    #[test]
    fn layers_of_a_material_add_up_and_what_a_list_leaves_out_is_not_in_the_beam() {
        use FilterMaterial::{Aluminum, Copper, Lead};
        let wedge = FilterLayer { material: Copper, thickness_mm: Some([0.5, 1.0]) };
        let mut several = header(None, &[(Copper, Some(0.25)), (Lead, None)]);
        several.layers.push(wedge);
        let against_others = |filter: &AddedFilter| [Copper, Aluminum, Lead].map(|material| filter.thickness_mm(material, true));
        assert_eq!(against_others(&several), [Some([0.75, 1.25]), None, None]);
        let listed = header(Some(FilterForm::Flat), &[(Aluminum, Some(1.0))]);
        assert_eq!(against_others(&listed), [Some([0.0; 2]), Some([1.0; 2]), Some([0.0; 2])]);
        let none = header(Some(FilterForm::NoFilter), &[]);
        assert_eq!(against_others(&none), [Some([0.0; 2]), None, Some([0.0; 2])]);
        // A zero beside a material, and a filter of which no material is named.
        for open in [header(None, &[(Copper, Some(0.0))]), header(Some(FilterForm::Flat), &[])] {
            assert_eq!(open.thickness_mm(Copper, true), None, "{open:?}");
        }
    }

    #[test]
    fn a_filter_is_told_in_words_and_what_is_none_is_refused() {
        let words = ["none", "copper=0.2", "Al=1, cu=0.1", "copper=0"].map(|text| typed(text).words());
        let expected = ["no added filter", "0.20 mm of copper", "1.00 mm of aluminium and 0.10 mm of copper", "no added filter"];
        assert_eq!(words, expected);
        assert_eq!(header(Some(FilterForm::Flat), &[]).words(), "a filter whose material is not stated");
        let unnamed = header(None, &[(FilterMaterial::Copper, Some(0.2)), (FilterMaterial::Other, None)]);
        assert_eq!(unnamed.words(), "0.20 mm of copper and another material of a thickness that is not stated");
        for wrong in ["", "copper", "copper=-1", "copper=NaN", "water=3", "none,copper=1"] {
            let error = wrong.parse::<AddedFilter>().expect_err("none").to_string();
            assert!(error.contains("copper=0.2") && error.contains("niobium"), "{error}");
        }
    }
}
